"""report.yaml: what is written is read back, entries find their findings, mistakes are told."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from thermosplat.errors import UserError
from thermosplat.reporting.report_file import Entry, ReportFile, read_report, write_first
from thermosplat.reporting.texts import FORM


def _finding(*place: float) -> Any:
    return SimpleNamespace(region=SimpleNamespace(place=place, size=(0.1, 0.1, 0.1)))


@pytest.mark.parametrize("hostile", ['a "b": {c}', "${oc.env:HOME}", "x\n- *y", "\udcff", "# no", "😀\x07"])
def test_written_and_read(tmp_path: Path, hostile: str) -> None:
    """All fields are there, whatever a file calls its camera."""
    path = tmp_path / "report.yaml"
    write_first(path, [_finding(1.0, 2.0, 3.0)], {"instrument": hostile})
    said = read_report(path)
    assert list(said.form) == list(FORM)
    assert said.form["instrument"]
    assert not any(text for name, text in said.form.items() if name != "instrument")
    assert said.findings == (Entry((1.0, 2.0, 3.0)),)
    assert said.irradiance is None


def test_entries_find_their_findings() -> None:
    """By place, in the order of the file; new findings come last, and some are left out."""
    said = ReportFile(
        findings=(
            Entry((5.0, 0.0, 0.0), title="chimney"),
            Entry((0.1, 0.0, 0.0), title="window"),
            Entry((9.0, 0.0, 0.0), leave_out=True),
            Entry((50.0, 0.0, 0.0), title="gone"),
        )
    )
    found = [_finding(0.0, 0.0, 0.0), _finding(20.0, 0.0, 0.0), _finding(5.2, 0.0, 0.0), _finding(9.0, 0.0, 0.0)]
    listed, fresh = said.ordered(found, 1.0)
    assert [entry.title for _, entry in listed] == ["chimney", "window", ""]
    assert listed[-1][0].region.place[0] == 20.0
    assert fresh == 1


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("titel: x", "titel is unknown"),
        ("form: {clint: x}", "form.clint is unknown"),
        ("form: [x]", "must hold keys and values"),
        ("findings: [{place: [1, 2]}]", "needs a place"),
        ("findings: [{place: [1, 2, .nan]}]", "needs a place"),
        ("findings: [{place: [1, 2, 3], leave_out: maybe}]", "true or false"),
        ("findings: [{place: [1, 2, 3], title: {a: 1}}]", "title must be a text"),
        ("photovoltaics: {irradiance: bright}", "number of W/m²"),
        ("photovoltaics: {irradiance: 0}", "number of W/m²"),
        ("photovoltaics: {irradiance: .nan}", "number of W/m²"),
        ("photovoltaics: {irradiance: true}", "number of W/m²"),
        ("title: ${x}", "not expanded"),
    ],
)
def test_mistakes(tmp_path: Path, text: str, part: str) -> None:
    """One sentence each."""
    path = tmp_path / "report.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_report(path)
    assert part in error.value.message


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    """Nobody waits for its end."""
    os.mkfifo(tmp_path / "report.yaml")
    with pytest.raises(UserError, match="Cannot read"):
        read_report(tmp_path / "report.yaml")
