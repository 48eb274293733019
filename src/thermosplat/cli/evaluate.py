"""thermosplat-eval: a trained run against its held-out views."""

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from thermosplat.cli.errors import run_command
from thermosplat.cli.run_arguments import RunOnCaptureArguments

if TYPE_CHECKING:
    from thermosplat.cli.loaded_run import LoadedRun
    from thermosplat.labelled_regions import Regions


@dataclass(frozen=True)
class EvalArguments(RunOnCaptureArguments):
    """Render the held-out views of a trained run and compare them with their images: numbers, per-view CSV, PNGs."""

    lpips_weights: str | None = None
    """Folder or file with LPIPS backbone weights (torchvision state_dict). None: as the run was told."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    arguments = tyro.cli(EvalArguments, prog="thermosplat-eval", args=sys.argv[1:] if argv is None else argv)
    return run_command(lambda: _evaluate(arguments), debug=arguments.debug)


def _evaluate(arguments: EvalArguments) -> int:
    from rich.console import Console

    from thermosplat.cli.loaded_run import load_run
    from thermosplat.evaluation import evaluate
    from thermosplat.labelled_regions import write_regions
    from thermosplat.lpips import find_lpips

    console = Console(highlight=False, soft_wrap=True)
    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    capture = loaded.capture(arguments.data)
    for note in capture.notes:
        console.print(note, markup=False)
    lpips, lpips_note = find_lpips(arguments.lpips_weights or loaded.config.lpips_weights, loaded.device)
    console.print(lpips_note, markup=False)
    run = loaded.directory
    strips, table = run.renders / f"eval_{loaded.step:06d}", run.stats / f"eval_{loaded.step:06d}.csv"
    strips.mkdir(exist_ok=True)
    metrics = evaluate(
        loaded.model,
        capture,
        sh_degree=loaded.sh_degree,
        device=loaded.device,
        lpips=lpips,
        strips_dir=strips,
        csv_path=table,
    )
    numbers = run.stats / f"eval_{loaded.step:06d}.json"
    run.write_json(numbers, {**metrics, "steps": loaded.step})
    _print_metrics(console, loaded, metrics)
    regions = write_regions(run, loaded.model, capture, loaded.step, loaded.sh_degree, loaded.device)
    if regions is not None:
        _print_regions(console, regions)
        console.print(f"By region {run.regions_json}", markup=False)
    console.print(f"Numbers {numbers}, per view {table}, pictures {strips}", markup=False)
    return 0


def _print_metrics(console: Any, loaded: "LoadedRun", metrics: dict[str, Any]) -> None:
    from rich.table import Table

    title = f"step {loaded.step:,}, {metrics['num_gaussians']:,} Gaussians"
    table = Table("held-out views", r"PSNR \[dB]", "SSIM", "LPIPS", "MAE [°C]", title=title, title_justify="left")
    for modality, label in (("rgb", "RGB"), ("thermal", "thermal")):
        numbers = metrics[modality]
        if numbers is not None:
            columns = (("psnr", ".2f"), ("ssim", ".4f"), ("lpips", ".4f"), ("mae_celsius", ".2f"))
            table.add_row(label, *(_cell(numbers.get(column), form) for column, form in columns))
    console.print(table)


def _print_regions(console: Any, regions: "Regions") -> None:
    from rich.table import Table

    from thermosplat.labelled_regions import COLUMNS

    headings = [column.heading.replace("[", r"\[") for column in COLUMNS]
    table = Table("region", "pixels", *headings, title="held-out views by region", title_justify="left")
    for name, numbers in regions.items():
        values = [column.value(numbers) for column in COLUMNS]
        texts = ["-" if value is None else column.form.format(value) for column, value in zip(COLUMNS, values)]
        table.add_row(name, f"{numbers['pixels']:,}", *texts)
    console.print(table)


def _cell(number: float | None, form: str) -> str:
    return "-" if number is None else format(number, form)
