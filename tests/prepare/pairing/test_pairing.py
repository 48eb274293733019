"""Pairs: by which rule, what is left over, what is refused."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from camera_folders import write_two_cameras
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow, PairRow
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.pairing.pairing import name_key, number_key, pair_frames
from thermosplat.runs.atomic_writes import write_bytes

START = datetime(2024, 10, 30, 10, 50)
GAPS = np.cumsum(np.random.default_rng(0).uniform(3, 9, 12))
"""When images are taken, at irregular moments [s]."""


def capture_of(root: Path, photographs: list[str], thermals: list[str], **times: list[float]) -> CaptureFolder:
    """An imported capture with these source files, and times of each spectrum [s]."""
    capture = CaptureFolder(root)
    rows = []
    for spectrum, sources in (("rgb", photographs), ("thermal", thermals)):
        for place, source in enumerate(sources):
            moment = START + timedelta(seconds=times[spectrum][place]) if spectrum in times else None
            name = f"{place:03d}.png"
            rows.append(FrameRow(spectrum, name, source, 8, 6, time=moment and moment.isoformat()))
    capture.write_frames(rows)
    write_bytes(capture.marker("import"), b"{}")
    return capture


def places(capture: CaptureFolder) -> list[tuple[int, int]]:
    """The pairs as numbers of the photograph and of the thermal image."""
    return [(int(pair.rgb[:3]), int(pair.thermal[:3])) for pair in capture.read_pairs()]


@pytest.mark.parametrize(
    ("photograph", "thermal", "why"),
    [
        ("VIS_{:04d}.jpg", "IR_{:04d}.tiff", "names agree"),
        ("V/10-5{}-42-994-visible.jpg", "R/10-5{}-42-994-radiometric.tiff", "names agree"),
        ("DJI_2024_{:04d}_W.JPG", "DJI_2024_{:04d}_T.JPG", "names agree"),
        ("one/img{}.jpg", "two/img{}.jpg", "names agree"),
        ("DSC{:05d}.jpg", "flight_{}.tiff", "last numbers"),
        ("FLIR{}.jpg", "FLIR{}.jpg", "same files"),
    ],
)
def test_pairs_by_name(tmp_path: Path, photograph: str, thermal: str, why: str) -> None:
    """Names that agree but for the camera, numbers, and photographs out of the thermal files themselves."""
    wanted = [(place, 5 - place) for place in range(6)]
    capture = capture_of(
        tmp_path,
        [photograph.format(number) for number in range(6)],
        [thermal.format(number) for number in reversed(range(6))],
    )
    said = " ".join(pair_frames(capture).sentences)
    assert places(capture) == wanted
    assert why in said
    assert "no partner" not in said


def test_pairs_by_time(tmp_path: Path) -> None:
    """Names that say nothing: the clocks' difference is found and said, what is left over is listed."""
    capture = capture_of(
        tmp_path,
        [f"a{chr(97 + place)}.jpg" for place in range(12)],
        [f"z{chr(97 + place)}.png" for place in range(11)],
        rgb=list(GAPS),
        thermal=list(GAPS[1:] - 71.5),
    )
    said = " ".join(pair_frames(capture).sentences)
    assert places(capture) == [(place + 1, place) for place in range(11)]
    assert "11 pairs of 12 photographs and 11 thermal images" in said
    assert "the thermal clock is 71.5 s behind that of the photographs" in said
    assert "1 photograph has no partner: 000.png." in said


def test_clock_that_jumps_is_said(tmp_path: Path) -> None:
    """With the place and the change."""
    thermal = GAPS + np.where(np.arange(12) < 8, 0.0, 40.0)
    capture = capture_of(
        tmp_path, ["a.jpg"] * 12, ["b.png"] * 12, rgb=list(GAPS), thermal=list(thermal)
    )  # names that are of no use
    said = " ".join(pair_frames(capture, "time").sentences)
    assert "a clock jumps by +40.0 s" in said
    assert places(capture) == [(place, place) for place in range(12)]


def test_pairs_by_order(tmp_path: Path) -> None:
    """The last resort for equally many images, in the order of their numbers; otherwise only if it is asked for."""
    capture = capture_of(tmp_path, ["x/a9.jpg", "x/a10.jpg"], ["one.png", "two.png"])
    assert "order alone" in " ".join(pair_frames(capture).sentences)
    assert places(capture) == [(0, 0), (1, 1)]
    other = capture_of(tmp_path / "other", ["a.jpg", "b.jpg", "c.jpg"], ["one.png", "two.png"])
    with pytest.raises(UserError, match=r"3 photographs and 2 thermal images could not be paired \(by source 0"):
        pair_frames(other)
    assert not other.marker("pair").exists()
    pair_frames(other, "order")
    assert places(other) == [(0, 0), (1, 1)]


def test_what_is_compared_of_names() -> None:
    """What is compared of names."""
    row = FrameRow("thermal", "", "F/DJI_2024_0007_T.JPG", 1, 1)
    assert (name_key(row), number_key(row)) == ("dji 2024 0007", "7")
    frame = FrameRow("thermal", "", "thermal.mp4#30", 1, 1)
    assert (name_key(frame), number_key(frame)) == ("30", "30")


def test_nothing_imported(tmp_path: Path) -> None:
    """The message names the command that comes first."""
    with pytest.raises(UserError, match="thermosplat-prepare import FOLDER --out"):
        pair_frames(CaptureFolder(tmp_path))


def test_imported_files_are_paired(tmp_path: Path) -> None:
    """Import and pair together; again it is complete already, and a new import makes it be done again."""
    capture = CaptureFolder(tmp_path / "capture")
    import_files(write_two_cameras(tmp_path / "in"), capture)
    pair_frames(capture)
    assert capture.read_pairs()[0] == PairRow("VIS_0001.jpg", "IR_0001.png")
    assert pair_frames(capture).before
    write_two_cameras(tmp_path / "in", 8)
    import_files(tmp_path / "in", capture)
    assert not pair_frames(capture).before
    assert len(capture.read_pairs()) == 8
