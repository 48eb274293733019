"""thermosplat-measure: the measurements of a run again, without a browser, as a table and as files."""

import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.cli.recalculating import known_scale
from thermosplat.cli.run_arguments import RunOnCaptureArguments
from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.errors import UserError
from thermosplat.printing import SafeConsole

if TYPE_CHECKING:
    from thermosplat.thermography.measurement_book import Pages
    from thermosplat.viewer.measuring import Measurer


@dataclass(frozen=True)
class MeasureArguments(TemperatureSettings, RunOnCaptureArguments):
    """Measure what thermosplat-view measured in a run again: the same numbers, without a browser.

    Examples:
      thermosplat-measure results/shed
      thermosplat-measure results/shed spots.json --emissivity 0.93 --output measured
      thermosplat-measure results/shed --above 40
    """

    measurements: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[MEASUREMENTS.JSON]")] = None
    """Measurements of thermosplat-view, or written by hand. None: RUN/measurements/measurements.json."""
    above: float | None = None
    """Also list the regions of the whole scene above this value, with place, extent and maximum."""
    below: float | None = None
    """The same of regions below this value."""
    output: str | None = None
    """Folder for measured.csv, measured.json and regions.json. None: RUN/measurements."""


def _measure(arguments: MeasureArguments) -> int:
    with importing():
        from thermosplat.runs.atomic_writes import write_text
        from thermosplat.thermography.measurement_book import Pages
        from thermosplat.thermography.measurements import Definition
        from thermosplat.thermography.measurements_file import MEASUREMENTS, read_book, table_text, write_book
        from thermosplat.viewer.layers import LayerRenderer
        from thermosplat.viewer.measuring import Measurer
        from thermosplat.viewer.opening import open_scene

    if arguments.above is not None and arguments.below is not None:
        raise UserError("--above and --below are two lists of regions.", "Give one of the two.")
    is_default = arguments.measurements is None
    kept = Path(os.path.expanduser(arguments.run)) / "measurements" / MEASUREMENTS
    file = kept if arguments.measurements is None else Path(os.path.expanduser(arguments.measurements))
    wants_regions = arguments.above is not None or arguments.below is not None
    if is_default and wants_regions and not file.is_file():
        pages, definitions = Pages(), list[Definition]()
    else:
        pages, definitions = read_book(file)
    stored: dict[str, Any] = dict(pages.settings)
    settings = arguments.checked().over(TemperatureSettings(**stored))
    scene, folder, notes = open_scene(
        arguments.run,
        step=arguments.step,
        data=arguments.data,
        device=arguments.device,
        settings=settings,
        scale_of=lambda capture: pages.metres_per_unit or known_scale(capture),
    )
    for note in notes:
        print(note)
    measurer = Measurer(LayerRenderer(scene))
    made = measurer.again(pages, definitions)
    metres = measurer.temperatures.metres_per_unit
    made = Pages(made.measurements, made.differences, metres, settings.given)
    folder = folder if arguments.output is None else Path(os.path.expanduser(arguments.output))
    if definitions:
        _print_measured(made)
        for lost in {one.name for one in definitions} - {one.name for one in made.measurements}:
            print(f"{lost} has no value any more, and is left out.")
        write_text(folder / "measured.csv", table_text(made))
        write_book(folder / "measured.json", made)
        print(f"{folder / 'measured.csv'} and measured.json")
    if wants_regions:
        _write_regions(arguments, measurer, metres, folder)
    return 0


def _print_measured(pages: "Pages") -> None:
    from rich.table import Table

    table = Table("name", "shape", "of", "value", "extent", "alarm")
    for one in pages.measurements:
        alarm, share = one.definition.alarm, one.numbers.alarm_share
        said = "" if alarm is None else f"{alarm.text}: {share or 0:.0%}"
        extent = one.extent_text(pages.metres_per_unit)
        table.add_row(one.name, one.definition.shape, one.definition.spectrum, one.text, extent, said)
    for first, second in pages.differences:
        if (found := pages.difference(first, second)) is not None:
            table.add_row(f"{first} - {second}", "difference", "", f"{found[0]:+.2f} {found[1]}", "", "")
    SafeConsole(highlight=False, soft_wrap=True).print(table)
    for reason in dict.fromkeys(reason for one in pages.measurements for reason in one.numbers.reasons):
        print(reason)


def _write_regions(arguments: MeasureArguments, measurer: "Measurer", metres: float | None, folder: Path) -> None:
    from rich.table import Table

    from thermosplat.runs.atomic_writes import write_text

    colder = arguments.above is None
    threshold = arguments.below if arguments.above is None else arguments.above
    spectrum = measurer.measured_spectrum()
    found = measurer.regions(spectrum, float(threshold or 0.0), colder=colder)
    unit = "m" if metres else "units"
    table = Table("region", "least" if colder else "most", f"area [{unit}²]", f"size [{unit}]", "place", "views", "see")
    scale = metres or 1.0
    for number, (one, frame) in enumerate(found, 1):
        size = " x ".join(f"{side * scale:.2g}" for side in one.size)
        place = " ".join(f"{x:.4g}" for x in one.place)
        cells = (f"{one.extreme:.2f}", f"{one.area * scale**2:.3g}", size, place, str(one.views), frame)
        table.add_row(str(number), *cells)
    SafeConsole(highlight=False, soft_wrap=True).print(table)
    listed = [{**asdict(one), "frame": frame} for one, frame in found]
    content = {"spectrum": spectrum, "threshold": threshold, "colder": colder, "metres_per_unit": metres}
    write_text(folder / "regions.json", json.dumps({**content, "regions": listed}, indent=1) + "\n")
    print(f"{len(found)} regions: {folder / 'regions.json'}")


main = program(MeasureArguments, _measure, prog="thermosplat-measure")

if __name__ == "__main__":
    sys.exit(main())
