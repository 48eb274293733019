"""thermosplat-eval: a trained run against its held-out views."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunOnCaptureArguments
from thermosplat.config_files import data_from_anywhere

if TYPE_CHECKING:
    from thermosplat.cli.loaded_run import LoadedRun
    from thermosplat.labelled_regions import Regions

_LABELS = {"rgb": "RGB", "thermal": "thermal"}
_REGION_COLUMNS = (
    *(("pixels", "", ""), (r"PSNR \[dB]", "psnr", ".2f"), ("MAE", "mae", ".4f"), ("MAE [°C]", "mae_celsius", ".2f")),
    *(("depth", "depth_error", ".3f"), ("of it", "depth_error_relative", ".1%"), ("on own", "on_own_surface", ".0%")),
)
"""Heading, measure and form."""


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
    return run_program(EvalArguments, _evaluate, argv, prog="thermosplat-eval")


def _evaluate(arguments: EvalArguments) -> int:
    with importing():
        from rich.console import Console

        from thermosplat.cli.loaded_run import load_run
        from thermosplat.evaluation import evaluate, file_stem
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
    name = loaded.result_name(capture)
    strips, table = run.renders / f"eval_{name}", run.stats / f"eval_{name}.csv"
    metrics = evaluate(
        loaded.model,
        capture,
        sh_degree=loaded.sh_degree,
        device=loaded.device,
        lpips=lpips,
        strips_dir=strips,
        csv_path=table,
    )
    shown = {f"{file_stem(frame.name)}.png" for frame in capture.test}
    for earlier in strips.glob("*.png"):
        if earlier.name not in shown:  # of frames that were held out at another time
            earlier.unlink()
    numbers = run.stats / f"eval_{name}.json"
    data = data_from_anywhere(arguments.data or loaded.config.data)
    run.write_json(numbers, {**metrics, "steps": loaded.step, "data": data})
    _print_metrics(console, loaded, metrics)
    by_region = run.regions_json if loaded.is_own(capture) else run.stats / f"regions_{name}.json"
    regions = write_regions(run, loaded.model, capture, loaded.step, loaded.sh_degree, loaded.device, path=by_region)
    if regions is not None:
        _print_regions(console, regions)
        console.print(f"By region {by_region}", markup=False)
    console.print(f"Numbers {numbers}, per view {table}, pictures {strips}", markup=False)
    return 0


def _print_metrics(console: Any, loaded: "LoadedRun", metrics: dict[str, Any]) -> None:
    from rich.table import Table

    title = f"step {loaded.step:,}, {metrics['num_gaussians']:,} Gaussians"
    table = Table("held-out views", r"PSNR \[dB]", "SSIM", "LPIPS", "MAE [°C]", title=title, title_justify="left")
    for modality, label in _LABELS.items():
        numbers = metrics[modality]
        if numbers is not None:
            columns = (("psnr", ".2f"), ("ssim", ".4f"), ("lpips", ".4f"), ("mae_celsius", ".2f"))
            table.add_row(label, *(_cell(numbers.get(column), form) for column, form in columns))
    console.print(table)


def _print_regions(console: Any, regions: "Regions") -> None:
    from rich import box
    from rich.table import Table

    title = "held-out views by region; depth errors are medians"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("region", no_wrap=True)
    table.add_column("", no_wrap=True)
    for heading, _, _ in _REGION_COLUMNS:
        table.add_column(heading, justify="right")
    for region, numbers in regions.items():
        shown, pixels = region, f"{numbers['pixels']:,}"
        for modality, of_modality in ((name, numbers[name]) for name in ("rgb", "thermal")):
            if of_modality is not None:
                texts = [_cell(of_modality.get(measure), form) for _, measure, form in _REGION_COLUMNS[1:]]
                table.add_row(shown, _LABELS[modality], pixels, *texts)
                shown = pixels = ""
    console.print(table)


def _cell(number: float | None, form: str) -> str:
    return "-" if number is None else format(number, form)
