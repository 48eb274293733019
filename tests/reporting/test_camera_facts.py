"""Instrument and date of the form, from what the files of a capture stated."""

from pathlib import Path

import pytest

from thermosplat.reporting.camera_facts import camera_facts

FRAMES = """spectrum,file,time,make,model
rgb,a.jpg,2026-06-12T10:00:07,DJI,M3T
rgb,b.jpg,2026-06-12T10:05:03,DJI,M3T
rgb,c.jpg,2026-06-11T09:00:00,DJI,M3T
thermal,a.png,{},FLIR,Vue
thermal,b.png,,FLIR,Vue
"""


@pytest.mark.parametrize(
    ("own", "pairs", "date"),
    [
        ("", "rgb,thermal\na.jpg,a.png\nb.jpg,b.png,more\n", "2026-06-12 10:00 - 2026-06-12 10:05"),
        ("2026-06-12T22:10:00", "rgb,thermal\na.jpg,a.png\n", "2026-06-12 22:10"),
        ("", "rgb,thermal\n", None),
        ("", None, None),
    ],
)
def test_the_date_is_that_of_images_taken_together(
    tmp_path: Path, own: str, pairs: str | None, date: str | None
) -> None:
    """Photographs of another hour say nothing of thermal images; nor do those without a partner."""
    (tmp_path / "frames.csv").write_text(FRAMES.format(own))
    if pairs is not None:
        (tmp_path / "pairs.csv").write_text(pairs)
    found = camera_facts(tmp_path, "thermal")
    assert found.get("date") == date
    assert found["instrument"] == "FLIR Vue"


def test_a_damaged_table_says_nothing(tmp_path: Path) -> None:
    """Nor does a folder without one."""
    assert camera_facts(tmp_path, "thermal") == {}
    (tmp_path / "frames.csv").write_bytes(b"\xff\xfe\x00")
    assert camera_facts(tmp_path, "thermal") == {}
