"""thermosplat-eval: a trained run against its held-out views."""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.cli.recalculating import asked_temperatures
from thermosplat.cli.run_arguments import RunOnCaptureArguments
from thermosplat.config.files import data_from_anywhere
from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.printing import SafeConsole
from thermosplat.spectra import label, measured_error, unit_label

if TYPE_CHECKING:
    from thermosplat.evaluation.labelled_regions import Regions
    from thermosplat.evaluation.loaded_run import LoadedRun

_COLUMNS = {"psnr": ".2f", "ssim": ".4f", "lpips": ".4f"}
"""Metrics of every spectrum, and their form."""
_DEPTH_COLUMNS = (("depth", "depth_error", ".3f"), ("of it", "depth_error_relative", ".1%"))
_ON_OWN_COLUMN = ("on own", "on_own_surface", ".0%")
"""Heading, measure and form."""


@dataclass(frozen=True)
class EvalArguments(TemperatureSettings, RunOnCaptureArguments):
    """Render the held-out views of a trained run and compare them with their images: numbers, per-view CSV, PNGs."""

    lpips_weights: str | None = None
    """Folder or file with LPIPS backbone weights (torchvision state_dict). None: as the run was told."""


def _evaluate(arguments: EvalArguments) -> int:
    with importing():
        from thermosplat.evaluation.coherence import coherence
        from thermosplat.evaluation.held_out import file_stem
        from thermosplat.evaluation.held_out_poses import evaluate_refined, unrefined_sentences
        from thermosplat.evaluation.labelled_regions import write_regions
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.evaluation.results_page import write_results_page
        from thermosplat.image_quality.lpips import find_lpips

    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    capture = loaded.capture(arguments.data)
    for note in (*loaded.notes, *capture.notes):
        print(note)
    lpips, lpips_note = find_lpips(arguments.lpips_weights or loaded.config.lpips_weights, loaded.device)
    print(lpips_note)
    temperatures = asked_temperatures(arguments, loaded, capture)
    run = loaded.directory
    name = loaded.result_name(capture) + ("_recalculated" if temperatures.text else "")
    strips, table = run.pictures("renders", f"eval_{name}"), run.stats / f"eval_{name}.csv"
    judged = evaluate_refined(
        loaded.model,
        capture,
        loaded.config,
        sh_degree=loaded.sh_degree,
        lpips=lpips,
        strips_dir=strips,
        csv_path=table,
        temperatures=temperatures,
    )
    metrics = judged.metrics
    shown = {f"{file_stem(frame.name)}.png" for frame in capture.test}
    for earlier in strips.glob("*.png"):
        if earlier.name not in shown:  # of frames that were held out at another time
            earlier.unlink()
    coherent = coherence(loaded.model, judged.capture, sh_degree=loaded.sh_degree)
    numbers = run.stats / f"eval_{name}.json"
    data = data_from_anywhere(arguments.data or loaded.config.data)
    recalculated = {"recalculated": temperatures.text} if temperatures.text else {}
    run.write_json(numbers, {**metrics, **recalculated, "coherence": coherent, "steps": loaded.step, "data": data})
    _print_metrics(loaded, metrics, temperatures.text)
    for pair, found in coherent.items():
        print(
            f"Coherence of {pair}: depths {found['depth_difference']:.1%} apart in the median, edges of depths agree "
            f"by {found['depth_edges']:.0%}, of images by {found['image_edges']:.0%}."
        )
    for sentence in unrefined_sentences(metrics):
        print(sentence)
    is_usual = loaded.is_own(capture) and not temperatures.text
    by_region = run.regions_json if is_usual else run.stats / f"regions_{name}.json"
    regions = write_regions(
        run,
        loaded.model,
        judged.capture,
        loaded.step,
        loaded.sh_degree,
        path=by_region,
        temperatures=temperatures,
    )
    if regions is not None:
        _print_regions(regions)
        print(f"By region {by_region}")
    write_results_page(run)
    print(f"Numbers {numbers}, per view {table}, pictures {strips}")
    return 0


def _print_metrics(loaded: "LoadedRun", metrics: dict[str, Any], recalculated: str) -> None:
    from rich.table import Table

    title = ", ".join(filter(None, (f"step {loaded.step:,}, {metrics['num_gaussians']:,} Gaussians", recalculated)))
    of_spectra = {name: metrics[name] for name in metrics["spectra"] if metrics[name] is not None}
    measured = {name: _in_its_unit(numbers) for name, numbers in of_spectra.items()}
    headings = ("MAE", "bias") if any(map(any, measured.values())) else ()
    table = Table("held out", r"PSNR \[dB]", "SSIM", "LPIPS", *headings, title=title, title_justify="left")
    for name, numbers in of_spectra.items():
        errors = [error or "-" for error in measured[name][: len(headings)]]
        table.add_row(label(name), *(_cell(numbers.get(column), form) for column, form in _COLUMNS.items()), *errors)
    console = SafeConsole(highlight=False, soft_wrap=True)
    console.print(table)
    for name, numbers in of_spectra.items():
        others = {key: value for key, value in numbers.items() if key not in _COLUMNS and measured_error(key) is None}
        if others:
            print(f"{label(name)}:", ", ".join(f"{key} {_cell(value, '.3f')}" for key, value in others.items()))
    for classes in metrics.get("classes", {}).values():
        for name, spectra in classes.items():
            for spectrum, found in spectra.items():
                print(_of_class(name, spectrum, found))


def _of_class(name: str, spectrum: str, found: Mapping[str, Any]) -> str:
    """What a spectrum measures of a class, in a line."""
    unit = unit_label(found["unit"])
    return (
        f"{name}, {label(spectrum)}: mean {found['mean']:.2f} {unit}, deviation {found['deviation']:.2f}, "
        f"{found['lowest']:.2f} to {found['highest']:.2f} ({found['pixels']:,} pixels)"
    )


def _in_its_unit(numbers: Mapping[str, Any]) -> tuple[str, str]:
    """Mean absolute error and bias of a spectrum's measured values, with their unit; "": nothing is measured."""
    found = {
        error.heading: f"{number:{error.sign}.2f} {error.unit}"
        for name, number in numbers.items()
        if number is not None and (error := measured_error(name)) is not None
    }
    return found.get("MAE", ""), found.get("bias", "")


def _measured_columns(numbers: Iterable[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Heading, measure and form of the errors of measured values that are there."""
    found = dict.fromkeys(name for of_spectrum in numbers for name in of_spectrum)
    errors = [(name, error) for name in found if (error := measured_error(name)) is not None]
    errors.sort(key=lambda one: one[1].heading)  # MAE of all units, then bias
    return [(rf"{error.heading} \[{error.unit}]", name, f"{error.sign}.2f") for name, error in errors]


def _print_regions(regions: "Regions") -> None:
    from rich import box
    from rich.table import Table

    title = "held-out views by region; depth errors are medians"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("region", no_wrap=True)
    table.add_column("", no_wrap=True)
    of_spectra = {
        region: {name: found for name, found in numbers.items() if isinstance(found, dict)}
        for region, numbers in regions.items()
    }
    measured = _measured_columns(found for spectra in of_spectra.values() for found in spectra.values())
    columns = [(r"PSNR \[dB]", "psnr", ".2f"), ("MAE", "mae", ".4f"), *measured, *_DEPTH_COLUMNS, _ON_OWN_COLUMN]
    for heading in ("pixels", *(heading for heading, _, _ in columns)):
        table.add_column(heading, justify="right")
    for region, spectra in of_spectra.items():
        shown, pixels = region, f"{regions[region]['pixels']:,}"
        for name, numbers in spectra.items():
            texts = [_cell(numbers.get(measure), form) for _, measure, form in columns]
            table.add_row(shown, label(name), pixels, *texts)
            shown = pixels = ""
    SafeConsole(highlight=False, soft_wrap=True).print(table)


def _cell(number: float | None, form: str) -> str:
    return "-" if number is None else format(number, form)


main = program(EvalArguments, _evaluate, prog="thermosplat-eval")

if __name__ == "__main__":
    sys.exit(main())
