"""Pairs: by which rule, what is left over, what is refused."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from camera_folders import write_two_cameras
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow, PairRow
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.pairing.file_names import folder_key, name_key, name_time, number_key
from thermosplat.prepare.pairing.pairing import pair_frames
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


def named(*sources: str) -> list[str]:
    """Sources out of patterns with a range of numbers: a/x_{1-3}.jpg."""
    found = []
    for source in sources:
        head, _, rest = source.partition("{")
        span, _, tail = rest.partition("}")
        first, _, last = span.partition("-")
        found += [f"{head}{number:04d}{tail}" for number in range(int(first), int(last) + 1)] if rest else [source]
    return found


@pytest.mark.parametrize(
    ("photographs", "thermals", "wanted"),
    [
        # numbers that begin again, one missing here and another one there
        (
            named("100MEDIA/DJI_{1-5}_V.JPG", "101MEDIA/DJI_{1-2}_V.JPG", "101MEDIA/DJI_{4-5}_V.JPG"),
            named("100MEDIA/DJI_{1-2}_T.JPG", "100MEDIA/DJI_{4-5}_T.JPG", "101MEDIA/DJI_{1-5}_T.JPG"),
            8,
        ),
        # the same number of each, which the order would pair wrongly
        (
            named("100MEDIA/DJI_{1-4}_V.JPG", "101MEDIA/DJI_{1-5}_V.JPG"),
            named("100MEDIA/DJI_{1-5}_T.JPG", "101MEDIA/DJI_{1-4}_T.JPG"),
            8,
        ),
        # nothing begins again, and still a camera writes both into one folder
        (named("100MEDIA/DJI_{1-9}_V.JPG"), named("100MEDIA/DJI_{1-8}_T.JPG", "101MEDIA/DJI_{9-9}_T.JPG"), 8),
        # words for the camera within the names of folders
        (
            named("flight1_rgb/{1-4}.jpg", "flight2_rgb/{1-4}.jpg"),
            named("flight1_thermal/{1-4}.tiff", "flight2_thermal/{1-4}.tiff"),
            8,
        ),
        # folders of two makers with the camera's number, inside folders of their own
        (
            named("cards/one/100CANON/IMG_{1-4}.JPG", "cards/one/101CANON/IMG_{1-4}.JPG"),
            named("cards/one/100_FLIR/IR_{1-4}.jpg", "cards/one/101_FLIR/IR_{1-4}.jpg"),
            8,
        ),
        # folders of one camera's hundreds, which go on counting
        (named("photos/100CANON/IMG_{1-9}.JPG"), named("ir/100_FLIR/IR_{1-4}.jpg", "ir/101_FLIR/IR_{5-9}.jpg"), 9),
    ],
)
def test_numbers_that_begin_again_in_other_folders(
    tmp_path: Path, photographs: list[str], thermals: list[str], wanted: int
) -> None:
    """Pairs lie in one folder, or in folders with one number; what has no partner there stays alone."""
    capture = capture_of(tmp_path, photographs, thermals)
    pair_frames(capture)
    paired = [(photographs[one], thermals[other]) for one, other in places(capture)]
    assert len(paired) == wanted
    for one, other in paired:
        assert Path(one).stem.strip("_V")[-4:] == Path(other).stem.strip("_T")[-4:]
        if wanted == 8:
            assert (
                one.rpartition("/")[0].replace("rgb", "")[:12] == other.rpartition("/")[0].replace("thermal", "")[:12]
            )


def test_order_does_not_lead_into_another_folder(tmp_path: Path) -> None:
    """Without numbers that agree, folders with other counts are not paired by order."""
    photographs = [f"100MEDIA/{name}.jpg" for name in "abcd"] + [f"101MEDIA/{name}.jpg" for name in "efg"]
    thermals = [f"100MEDIA/{name}.png" for name in "tuv"] + [f"101MEDIA/{name}.png" for name in "wxyz"]
    with pytest.raises(UserError, match="could not be paired"):
        pair_frames(capture_of(tmp_path, photographs, thermals))
    pair_frames(capture_of(tmp_path, photographs, thermals), "order")
    assert places(CaptureFolder(tmp_path)) == [(0, 0), (1, 1), (2, 2), (4, 3), (5, 4), (6, 5)]


@pytest.mark.parametrize("ahead", [0.0, 37.0, 36.6, -7261.4])
@pytest.mark.parametrize(
    ("photograph", "thermal"),
    [
        ("{:%Y%m%d_%H%M%S}.jpg", "{:%Y%m%d_%H%M%S}.tiff"),
        ("PXL_{:%Y%m%d_%H%M%S}123.jpg", "IR_{:%Y-%m-%dT%H-%M-%S}.tiff"),
        ("{:%s}.jpg", "thermal/{:%s}000000000.png"),
    ],
)
def test_pairs_by_times_in_names(tmp_path: Path, photograph: str, thermal: str, ahead: float) -> None:
    """A constant difference of the clocks, and whole seconds; one image is missing on each side."""
    moments = [START + timedelta(seconds=float(gap)) for gap in np.cumsum(np.random.default_rng(1).uniform(2, 6, 40))]
    late = [moment + timedelta(seconds=ahead) for moment in moments]
    capture = capture_of(
        tmp_path,
        [photograph.format(moment) for place, moment in enumerate(moments) if place != 11],
        [thermal.format(moment) for place, moment in enumerate(late) if place != 23],
    )
    pair_frames(capture)
    wanted = [(place - (place > 11), place - (place > 23)) for place in range(40) if place not in (11, 23)]
    assert places(capture) == wanted


def test_equal_seconds_of_other_moments_are_no_pairs(tmp_path: Path) -> None:
    """An image per second, and clocks 37 s apart: most names agree, and are of other moments."""
    sources = [f"{START + timedelta(seconds=place):%Y%m%d_%H%M%S}" for place in range(337)]
    capture = capture_of(tmp_path, [f"{one}.jpg" for one in sources[:300]], [f"{one}.tiff" for one in sources[37:]])
    assert "37.0 s ahead" in " ".join(pair_frames(capture).sentences)
    assert places(capture) == [(place, place) for place in range(300)]


def test_times_in_names_do_not_stand_for_numbers() -> None:
    """What is time, number and folder in names as they come."""

    def keys(source: str) -> tuple[float | None, str | None, str]:
        row = FrameRow("rgb", "", source, 1, 1)
        return name_time(row), number_key(row), folder_key(row)

    assert keys("DJI_202611201015_001_roof/DJI_20261120101506_0012_V.JPG") == (
        1795169706.0,
        "12",
        "dji 202611201015 001 roof",
    )
    assert keys("VisJPG/20261120_101506250.jpg") == (1795169706.25, None, "")
    assert keys("a/b_thermal/1795169706.25.png") == (1795169706.25, None, "a/b")
    assert keys("102_FLIR/20261320_101506.jpg") == (None, "101506", "102")
    assert keys("IMG_0042.jpg") == (None, "42", "")
