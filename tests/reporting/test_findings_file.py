"""findings.json: what is written is read back, and files of strangers are told of in a sentence."""

from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.reporting.findings_file import FINDINGS_FILE, REPORT_FOLDER, findings_text, read_findings


def test_written_and_read(tmp_path: Path) -> None:
    """Without a report there are none."""
    assert read_findings(tmp_path) == []
    (tmp_path / REPORT_FOLDER).mkdir()
    text = findings_text(
        "thermal", "°C", [{"name": "1 Ö", "text": "</script>", "place": [1, 2.5, -3], "mean": 4.0}], []
    )
    (tmp_path / REPORT_FOLDER / FINDINGS_FILE).write_text(text, "utf-8")
    (one,) = read_findings(tmp_path)
    assert (one.name, one.text, one.place) == ("1 Ö", "</script>", (1.0, 2.5, -3.0))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "x", "version": 1}', "[" * 100_000])
def test_something_else(tmp_path: Path, text: str) -> None:
    """One sentence and the command that writes it again."""
    (tmp_path / REPORT_FOLDER).mkdir()
    (tmp_path / REPORT_FOLDER / FINDINGS_FILE).write_text(text)
    with pytest.raises(UserError, match="no findings that can be read"):
        read_findings(tmp_path)


@pytest.mark.parametrize("place", ["[1, 2]", "[1, 2, 1e999]", '"abc"', "null"])
def test_a_place_that_is_none(tmp_path: Path, place: str) -> None:
    """Three finite numbers, or it is refused."""
    (tmp_path / REPORT_FOLDER).mkdir()
    text = findings_text("thermal", "", [{"name": "1", "text": "", "place": [0, 0, 0]}], [])
    text = text.replace("[\n    0,\n    0,\n    0\n   ]", place)
    assert place in text
    (tmp_path / REPORT_FOLDER / FINDINGS_FILE).write_text(text)
    with pytest.raises(UserError, match="no findings that can be read"):
        read_findings(tmp_path)
