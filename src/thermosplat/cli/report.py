"""thermosplat-report: findings and measurements of a run for a client, as HTML and PDF."""

import os
import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.cli.recalculating import known_scale
from thermosplat.cli.run_arguments import RunOnCaptureArguments
from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.thermography.measurement_book import Pages


@dataclass(frozen=True)
class ReportArguments(TemperatureSettings, RunOnCaptureArguments):
    """Write a report of a run for a client: what is warmer than its surroundings, and what was measured.

    What people say of it is in RUN/report.yaml, which the first report writes for you to fill in.

    Examples:
      thermosplat-report results/roof
      thermosplat-report results/roof --language de --delta 5 --emissivity 0.93
      thermosplat-report results/roof --colder --reference R1
      thermosplat-report results/june --compare comparison
    """

    language: Literal["en", "de"] = "en"
    """Of the report."""
    format: tuple[Literal["html", "pdf"], ...] = ("html", "pdf")
    """Files to write. PDF needs: pip install ".[report]"."""
    delta: float | None = None
    """Least difference to the reference [K, or the values' unit]. None: four times the usual one, and 1 K at least."""
    colder: bool = False
    """Look for what is colder than the reference."""
    reference: str | None = None
    """Name of a measurement, such as R1, whose mean is the reference. None: the median of the surroundings."""
    compare: str | None = None
    """Folder of thermosplat-compare: the report lists what changed since its first date. None: it does not."""
    output: str | None = None
    """Folder for report.html and report.pdf. None: RUN/report."""


def _report(arguments: ReportArguments) -> int:
    with importing():
        from thermosplat.reporting.camera_facts import camera_facts
        from thermosplat.reporting.content import Report, blocks_of, findings_of, things_of
        from thermosplat.reporting.findings import LEAST_DEGREES, find
        from thermosplat.reporting.findings_file import FINDINGS_FILE, REPORT_FOLDER, findings_text
        from thermosplat.reporting.page_html import html_of
        from thermosplat.reporting.page_pdf import pdf_library, pdf_of
        from thermosplat.reporting.report_file import REPORT_FILE, read_report, write_first
        from thermosplat.reporting.texts import Words
        from thermosplat.runs.atomic_writes import write_bytes, write_text
        from thermosplat.spectra import CELSIUS
        from thermosplat.thermography.comparison_file import read_comparison
        from thermosplat.thermography.measurement_book import Pages
        from thermosplat.thermography.measurements_file import FOLDER, MEASUREMENTS, read_book
        from thermosplat.viewer.layers import LayerRenderer
        from thermosplat.viewer.measuring import Measurer
        from thermosplat.viewer.opening import open_scene

    if arguments.delta is not None and not 0 < arguments.delta < 1e6:
        raise UserError(f"--delta {arguments.delta:g} is no difference.", "Give a number above 0.")
    if "pdf" in arguments.format:
        pdf_library()  # to say that it is missing before anything is rendered
    run = Path(os.path.expanduser(arguments.run))
    compared = None
    if arguments.compare is not None:
        comparison = read_comparison(Path(os.path.expanduser(arguments.compare)))
        compared = comparison, comparison.of(run)
    kept = run / FOLDER / MEASUREMENTS
    pages, definitions = read_book(kept) if kept.is_file() else (Pages(), [])
    own: dict[str, Any] = dict(pages.settings)
    scene, folder, notes = open_scene(
        arguments.run,
        step=arguments.step,
        data=arguments.data,
        device=arguments.device,
        settings=arguments.checked().over(TemperatureSettings(**own)),
        scale_of=lambda capture: pages.metres_per_unit or known_scale(capture),
    )
    for note in notes:
        print(note)
    if scene.capture is None:
        raise UserError("A report needs the capture, which is not at hand.", "--data FOLDER says where it lies.")
    measurer = Measurer(LayerRenderer(scene))
    pages = measurer.again(pages, definitions)
    file = folder.parent / REPORT_FILE
    said = read_report(file) if file.exists() else None  # mistakes in it are told before the long search
    spectrum = measurer.spectrum_of_values()
    in_degrees = scene.scales[spectrum].measured_unit == CELSIUS
    found = find(
        measurer,
        spectrum,
        limit=arguments.delta,
        reference=_reference(arguments.reference, pages, spectrum),
        colder=arguments.colder,
        least=LEAST_DEGREES if in_degrees else 0.0,
    )
    if said is None:
        write_first(file, found.findings, camera_facts(scene.capture.root, spectrum))
        print(f"{file}: fill it in, and run the command again.")
        said = read_report(file)
    metres = pages.metres_per_unit or known_scale(scene.capture) or (1.0 if scene.capture.geo else None)
    listed, without_entry = said.ordered(found.findings, metres)
    if without_entry:
        some = "1 finding is" if without_entry == 1 else f"{without_entry} findings are"
        print(f"{some} not in {file} and will come last in the report.")
    report = Report(
        words=Words(arguments.language),
        measurer=measurer,
        capture=scene.capture,
        spectrum=spectrum,
        date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M"),
        found=found,
        findings=listed,
        said=said,
        pages=pages,
        metres=metres,
        colder=arguments.colder,
        reference_name=arguments.reference,
        compared=compared,
    )
    blocks = blocks_of(report)
    output = folder.parent / REPORT_FOLDER if arguments.output is None else Path(os.path.expanduser(arguments.output))
    if "html" in arguments.format:
        write_text(output / "report.html", html_of(blocks, arguments.language))
        print(output / "report.html")
    if "pdf" in arguments.format:
        write_bytes(output / "report.pdf", pdf_of(blocks, arguments.language))
        print(output / "report.pdf")
    write_text(output / FINDINGS_FILE, findings_text(spectrum, report.unit, findings_of(report), things_of(report)))
    print(f"{len(listed)} finding{'' if len(listed) == 1 else 's'}")
    return 0


def _reference(name: str | None, pages: "Pages", spectrum: str) -> float | None:
    """Mean of the measurement that is the reference; None: there is none."""
    if name is None:
        return None
    known = {
        one.name: one.numbers.mean
        for one in pages.measurements
        if (one.definition.layer, one.definition.spectrum) == ("image", spectrum)
    }
    if name not in known:
        raise UserError(
            f"No measurement of {spectrum} is called {name}.",
            f"There are: {', '.join(known)}." if known else "Make one in thermosplat-view.",
        )
    return known[name]


main = program(ReportArguments, _report, prog="thermosplat-report")

if __name__ == "__main__":
    sys.exit(main())
