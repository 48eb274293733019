"""The tables of a prepared capture."""

from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow, PairRow

ROWS = [
    FrameRow("rgb", "a, b.jpg", "x/a, b.jpg", 800, 600, time="2026-01-02T03:04:05.678", latitude=-1.25, orientation=6),
    FrameRow("thermal", "ä.png", "ä.tiff", 320, 240, make='Maker "M"'),
]


def test_tables_are_read_back(tmp_path: Path) -> None:
    """What was written comes back, unknown fields as None; of one spectrum if asked."""
    capture = CaptureFolder(tmp_path / "new")
    capture.write_frames(ROWS)
    assert capture.read_frames() == ROWS
    assert capture.read_frames("thermal") == ROWS[1:]
    capture.write_pairs([PairRow("a, b.jpg", "ä.png")])
    assert capture.read_pairs() == [PairRow("a, b.jpg", "ä.png")]
    assert sorted(path.name for path in capture.root.iterdir()) == ["frames.csv", "pairs.csv"]


def test_missing_and_damaged_tables(tmp_path: Path) -> None:
    """The message names the file or its line, and the command that makes it."""
    capture = CaptureFolder(tmp_path)
    with pytest.raises(UserError, match=r"no frames.csv in .*thermosplat-prepare import"):
        capture.read_frames()
    with pytest.raises(UserError, match=r"no pairs.csv in .*thermosplat-prepare pair"):
        capture.read_pairs()
    capture.write_frames(ROWS)
    capture.frames_csv.write_text(capture.frames_csv.read_text().replace("320", "wide"))
    with pytest.raises(UserError, match=r"Line 3 of .*frames.csv is damaged"):
        capture.read_frames()


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "a/../../b.png"])
def test_names_stay_inside_the_capture(tmp_path: Path, name: str) -> None:
    """A table from a stranger leads nowhere else."""
    capture = CaptureFolder(tmp_path)
    capture.write_pairs([PairRow("a.jpg", name)])
    with pytest.raises(UserError, match=r"Line 2 of .*pairs.csv is damaged"):
        capture.read_pairs()
