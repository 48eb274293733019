"""The report of a run as blocks: first page, findings, measurements, photovoltaics, form."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermosplat.datasets.capture import Capture
from thermosplat.reporting.blocks import Block, Facts, Heading, Paragraph, Picture, Table
from thermosplat.reporting.changes import changes_since
from thermosplat.reporting.class_numbers import class_numbers
from thermosplat.reporting.drawings import in_all_spectra, map_frame, plan
from thermosplat.reporting.findings import Finding, Found, normalised
from thermosplat.reporting.report_file import Entry, ReportFile
from thermosplat.reporting.texts import FORM, Words
from thermosplat.spectra import CELSIUS, label, unit_label
from thermosplat.thermography.comparison_file import KnownComparison, LaterDate
from thermosplat.thermography.measurement_book import Pages
from thermosplat.viewer.measuring import Measurer

_LEAST_IRRADIANCE = 600.0
"""[W/m²] of IEC TS 62446-3."""


@dataclass(frozen=True, eq=False)
class Report:
    """What a report is made of."""

    words: Words
    measurer: Measurer
    capture: Capture
    spectrum: str
    """In which findings were looked for."""
    date: str
    """When the report is made."""
    found: Found
    findings: Sequence[tuple[Finding, Entry]]
    """In the order of the report."""
    said: ReportFile
    pages: Pages
    """The thermographer's measurements."""
    metres: float | None
    """Length of a world unit [m]; None: nobody knows it."""
    colder: bool
    reference_name: str | None
    """The measurement that is the reference; None: the surroundings."""
    compared: tuple[KnownComparison, LaterDate] | None = None
    """What the run was compared with; None: nothing."""

    @property
    def unit(self) -> str:
        """Of the values; "" of intensities."""
        return unit_label(self.measurer.scene.scales[self.spectrum].measured_unit or "")

    @property
    def in_degrees(self) -> bool:
        """Whether values are temperatures."""
        return self.measurer.scene.scales[self.spectrum].measured_unit == CELSIUS

    def value(self, number: float) -> str:
        """A value with its unit."""
        return f"{self.words.number(number, 2 if self.in_degrees else 3)} {self.unit}".rstrip()

    def step(self, number: float, *, sign: bool = True) -> str:
        """A difference of values with its unit: kelvin where they are temperatures."""
        unit = "K" if self.in_degrees else self.unit
        return f"{self.words.number(number, 2 if self.in_degrees else 3, sign=sign)} {unit}".rstrip()

    def given(self, text: str) -> str:
        """A text, or that there is none."""
        return text or self.words["not_given"]


def blocks_of(report: Report) -> list[Block]:
    """The report from its first page to its last."""
    parts = (_first_page, _plan, _findings, _things, _changes, _classes, _measurements, _photovoltaics, _form)
    return [block for part in parts for block in part(report)]


def findings_of(report: Report) -> list[dict[str, Any]]:
    """The findings for ``findings_file``, in the order of the report."""
    listed = []
    for number, (one, entry) in enumerate(report.findings, 1):
        numbers = [
            f"{report.words['mean']} {report.value(one.mean)}",
            f"{_delta(report)} {report.step(one.difference)}",
            f"{report.words['area']} {_area(report, one)}",
        ]
        said = filter(None, (*numbers, entry.severity, entry.comment))
        listed.append({"name": f"{number} {entry.title}".strip(), "text": ", ".join(said), **_plain(one)})
    return listed


def things_of(report: Report) -> list[dict[str, Any]]:
    """The things that are listed beside the findings, likewise."""
    return [_plain(one) for one in report.found.things]


def _plain(one: Finding) -> dict[str, Any]:
    return {
        "place": list(one.region.place),
        "minimum": one.minimum,
        "maximum": one.maximum,
        "mean": one.mean,
        "reference": one.reference,
        "area": one.surface,
    }


def _first_page(report: Report) -> Iterator[Block]:
    words, capture, found = report.words, report.capture, report.found
    yield Heading(report.said.title or words["report"], 1)
    if not report.in_degrees and not report.unit:
        yield Paragraph(words["intensities"], stands_out=True)
    form = report.said.form
    geo = capture.geo
    unit = report.unit or words["intensity"]
    reference = words["of_surroundings"]
    if report.reference_name is not None:
        reference = words["of_area"].format(report.reference_name)
    rows = [(words.field(name), report.given(form.get(name, ""))) for name in ("client", "object", "thermographer")]
    rows += [
        (words["capture"], capture.name),
        (words["folder"], str(capture.root)),
        (words["run"], report.measurer.scene.name.replace(", step ", words["step"])),
        (words.field("date"), report.given(form.get("date", ""))),
        (words["made"], report.date),
        (words.field("instrument"), report.given(form.get("instrument", ""))),
        (words["images"], ", ".join(f"{_images(capture, name)} {words.told(label(name))}" for name in capture.spectra)),
        (words["spectrum"], words.told(label(report.spectrum))),
        (words["unit"], unit),
        (words["scale"], words.formatted(report.metres, ".4g") if report.metres else words["unknown_scale"]),
    ]
    if geo is not None:
        rows.append((words["position"], f"{geo.latitude:.6f}°, {geo.longitude:.6f}°, UTM {geo.zone} (EPSG:{geo.epsg})"))
    rows += [
        (words["reference"], reference),
        (words["below" if report.colder else "above"], report.step(found.limit, sign=False)),
        (words["corrections"], _corrections(report)),
        (words["findings"], str(len(report.findings))),
    ]
    rows += [(words["not_read"], str(found.not_read))] if found.not_read else []
    rows += [(words["more"], str(found.more))] if found.more else []
    yield Facts(rows)
    if report.said.notes:
        yield Heading(words["notes"])
        yield Paragraph(report.said.notes)


def _plan(report: Report) -> Iterator[Block]:
    words = report.words
    frame = map_frame(report.capture, report.spectrum)
    picture, step = plan(frame, report.capture, report.spectrum, [one for one, _ in report.findings])
    is_metric = frame.crs is not None
    if not is_metric and report.metres:
        step, is_metric = step * report.capture.placement.unit * report.metres, True
    unit = "m" if is_metric else words["world_units"]
    yield Heading(words["plan"], new_page=True)
    caption = words["plan_local" if frame.crs is None else "plan_north"]
    yield Picture(picture, f"{caption} {words.formatted(step, '.3g')} {unit}", 0.75)


def _findings(report: Report) -> Iterator[Block]:
    words = report.words
    yield Heading(words["findings"], new_page=True)
    if not report.findings:
        yield Paragraph(words["no_findings"])
        return
    extreme = words["minimum" if report.colder else "maximum"]
    head = ["", words["severity"], extreme, words["mean"], _delta(report), words["area"]]
    rows = []
    for number, (one, entry) in enumerate(report.findings, 1):
        rows.append((f"{number} {entry.title}".strip(), report.given(entry.severity), *_numbers(report, one)))
    yield Table(head, rows)
    for number, (one, entry) in enumerate(report.findings, 1):
        yield from _finding(report, number, one, entry)


def _things(report: Report) -> Iterator[Block]:
    words, things = report.words, report.found.things
    if not things:
        return
    yield Heading(words["things"], new_page=True)
    more = f" {words['of_things']} {len(things) + report.found.more_things}." if report.found.more_things else ""
    yield Paragraph(words["about_things"] + more)
    extreme = words["minimum" if report.colder else "maximum"]
    rows = [(words.place(one.region.place, 2), *_numbers(report, one)) for one in things]
    yield Table([words["place"], extreme, words["mean"], _delta(report), words["area"]], rows)


def _changes(report: Report) -> Iterator[Block]:
    if report.compared is not None:
        yield from changes_since(*report.compared, report.words)


def _classes(report: Report) -> Iterator[Block]:
    words = report.words
    found = class_numbers(report.measurer, report.spectrum, report.found.views)
    if not found:
        return
    yield Heading(words["classes"], new_page=True)
    yield Paragraph(words["about_classes"])
    rows = [
        (one.name, _square(report, one.area), *map(report.value, (one.minimum, one.mean, one.maximum)), str(one.views))
        for one in found
    ]
    yield Table([words[name] for name in ("class_name", "area", "minimum", "mean", "maximum", "views")], rows)


def _numbers(report: Report, one: Finding) -> tuple[str, ...]:
    """The extreme, mean, difference and area of a finding."""
    extreme = one.minimum if report.colder else one.maximum
    return report.value(extreme), report.value(one.mean), report.step(one.difference), _area(report, one)


def _finding(report: Report, number: int, one: Finding, entry: Entry) -> Iterator[Block]:
    words, frame = report.words, one.seen.frame
    title = f"{words['finding']} {number}"
    yield Heading(f"{title}: {entry.title}" if entry.title else title, 3, new_page=number > 1)
    names = " | ".join(words.told(label(name)) for name in _shown_spectra(report))
    yield Picture(in_all_spectra(report.measurer, one, report.spectrum), f"{frame.name}: {names}")
    mean = report.value(one.mean)
    if one.uncertainty is not None:
        mean += f" ± {report.step(one.uncertainty, sign=False)}"
    rows = [
        (words["minimum"], report.value(one.minimum)),
        (words["maximum"], report.value(one.maximum)),
        (words["mean"], mean),
        (words["reference"], report.value(one.reference)),
        (_delta(report), report.step(one.difference)),
        (words["area"], _area(report, one)),
        (words["size"], _size(report, one)),
        (words["world"], words.place(one.region.place, 3)),
    ]
    if (geo := report.capture.geo) is not None:
        rows.append((words["enu"], words.place(one.region.place, 2)))
        utm = geo.to_utm(np.array(one.region.place))
        rows.append((words["utm"], f"{words.place(utm, 2)} ({geo.zone}, EPSG:{geo.epsg})"))
    nearest = report.measurer.renderer.photographs.nearest_frame
    viewmat = frame.views[report.spectrum].viewmat
    for name, scale in report.capture.scales.items():
        if scale.kind == "photograph":
            rows.append((words["photograph"], _file(report, nearest(name, viewmat).views[name].path)))
    rows.append((words["thermal_file"], _file(report, frame.views[report.spectrum].path)))
    rows.append((words["corrections"], _corrections(report)))
    rows += [(words["doubts"], "; ".join(map(words.doubt, one.doubts)))] if one.doubts else []
    rows += [(words["severity"], report.given(entry.severity)), (words["comment"], report.given(entry.comment))]
    yield Facts(rows)


def _measurements(report: Report) -> Iterator[Block]:
    words, pages = report.words, report.pages
    yield Heading(words["measurements"], new_page=bool(pages.measurements))
    if not pages.measurements:
        yield Paragraph(words["no_measurements"])
        return
    rows: list[tuple[str, ...]] = [
        (
            one.name,
            *map(words.told, (one.definition.shape, label(one.definition.spectrum), one.text)),
            words.told(one.extent_text(report.metres)),
        )
        for one in pages.measurements
    ]
    for first, second in pages.differences:
        if (found := pages.difference(first, second)) is not None:
            rows.append(
                (f"{first} - {second}", "Δ", "", f"{report.words.number(found[0], 2, sign=True)} {found[1]}", "")
            )
    yield Table([words[name] for name in ("name", "shape", "spectrum", "value", "extent")], rows)


def _photovoltaics(report: Report) -> Iterator[Block]:
    words, irradiance = report.words, report.said.irradiance
    if irradiance is None:
        return
    yield Heading(words["pv"], new_page=True)
    yield Paragraph(words["pv_source"])
    yield Facts([(words["irradiance"], f"{words.formatted(irradiance, 'g')} W/m²")])
    if not report.in_degrees:
        yield Paragraph(words["pv_no_degrees"], stands_out=True)
        return
    if irradiance < _LEAST_IRRADIANCE:
        yield Paragraph(words["pv_low"], stands_out=True)
    rows = []
    for number, (one, entry) in enumerate(report.findings, 1):
        at_most = one.minimum if report.colder else one.maximum
        far = at_most - one.reference
        scaled = report.step(normalised(far, irradiance))
        rows.append((f"{number} {entry.title}".strip(), report.step(far), scaled, report.given(entry.of_class)))
    extreme = words["minimum" if report.colder else "maximum"]
    yield Table([words["finding"], f"{words['delta']} ({extreme})", words["normalised"], words["class"]], rows)


def _form(report: Report) -> Iterator[Block]:
    words = report.words
    yield Heading(words["form"], new_page=True)
    yield Paragraph(words["form_source"])
    yield Facts([(words.field(name), report.given(report.said.form.get(name, ""))) for name in FORM])


def _delta(report: Report) -> str:
    return report.words["delta" if report.in_degrees else "difference"]


def _corrections(report: Report) -> str:
    made = report.measurer.temperatures
    return report.words.told(made.text) if made.recalculates(report.spectrum) else report.words["no_corrections"]


def _area(report: Report, one: Finding) -> str:
    return _square(report, one.surface)


def _square(report: Report, area: float) -> str:
    """An area [world units²]."""
    if report.metres:
        return f"{report.words.formatted(area * report.metres**2, '.3g')} m²"
    return f"{report.words.formatted(area, '.3g')} ({report.words['world_units']})²"


def _size(report: Report, one: Finding) -> str:
    sides = " x ".join(report.words.formatted(side * (report.metres or 1.0), ".2g") for side in one.region.size)
    return f"{sides} {'m' if report.metres else report.words['world_units']}"


def _file(report: Report, path: Path) -> str:
    """A file of the capture, as it lies in its folder."""
    root = report.capture.root
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


def _images(capture: Capture, spectrum: str) -> int:
    return sum(spectrum in frame.views for frame in (*capture.train, *capture.test))


def _shown_spectra(report: Report) -> list[str]:
    return [*(name for name in report.measurer.scene.model.spectra if name != report.spectrum), report.spectrum]
