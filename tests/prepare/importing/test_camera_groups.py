"""Photographs and thermal pictures that look alike, formats that are not read, and frames that a program turned."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from camera_folders import centikelvin, exif_segment, scene, write_photograph, write_two_cameras, write_values
from flir_jpeg import write_flir_jpeg
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.importing.import_options import ImportOptions
from thermosplat.prepare.importing.thermal_images import ThermalOptions


@pytest.fixture
def capture(tmp_path: Path) -> CaptureFolder:
    return CaptureFolder(tmp_path / "capture")


def write_grey(path: Path, number: int, size: tuple[int, int], spread: int = 0, **exif: Any) -> Path:
    """A JPEG of grey levels whose channels differ by so many levels."""
    level = scene(number, *size)[..., 1].astype(np.int16)
    tint = np.stack([level, level + spread // 2, level + spread], -1).clip(0, 255).astype(np.uint8)
    content = cv2.imencode(".jpg", tint[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content[:2] + (exif_segment(**exif) if exif else b"") + content[2:])
    return path


@pytest.mark.parametrize("spread", [0, 2, 5, 8])
def test_white_hot_pictures_are_grey(tmp_path: Path, capture: CaptureFolder, spread: int) -> None:
    """Their channels differ by some levels, and they are no FLIR Iron for that."""
    for number in range(5):
        write_photograph(tmp_path / "in" / f"P{number}.jpg", number)
        write_grey(tmp_path / "in" / f"S{number}.jpg", number, (64, 48), spread)
    said = " ".join(import_files(tmp_path / "in", capture).sentences)
    assert "Thermal pictures were turned into values." in said
    stored = read_image(capture.images("thermal") / "S3.png")
    assert stored.dtype == np.uint16
    assert np.abs(stored / 257 - scene(3, 64, 48)[..., 1]).mean() < 8


def test_mostly_cold_pictures_keep_their_palette(tmp_path: Path, capture: CaptureFolder) -> None:
    """Black with a small warm thing in FLIR Iron is not taken for grey."""
    from thermosplat.thermal.radiometry import FLIR_IRON

    for number in range(5):
        write_photograph(tmp_path / "in" / f"P{number}_rgb.jpg", number)
        intensity = np.zeros((48, 64))
        intensity[20:22, 30:34] = 0.25
        colors = np.rint(255 * FLIR_IRON.to_color(intensity)).astype(np.uint8)
        write_values(tmp_path / "in" / f"S{number}_thermal.png", colors[..., ::-1])
    import_files(tmp_path / "in", capture)
    stored = read_image(capture.images("thermal") / "S3_thermal.png")
    assert stored[21, 32] / 65535 == pytest.approx(0.25, abs=0.02)
    assert stored[0, 0] == 0


@pytest.mark.parametrize(
    ("size", "exif", "thermal_name"),
    [
        ((2100, 1575), {}, "S{}.jpg"),
        ((160, 120), {}, "S{}.jpg"),
        ((96, 72), {"iso": 100, "make": "Maker", "model": "Camera"}, "S{}.jpg"),
        ((160, 120), {}, "IR_{}.jpg"),
    ],
)
def test_photographs_of_a_grey_wall(
    tmp_path: Path, capture: CaptureFolder, size: tuple[int, int], exif: dict[str, Any], thermal_name: str
) -> None:
    """They are told from grey thermal pictures by their size, alone or beside others, and by their sensitivity."""
    for number in range(5):
        write_grey(tmp_path / "in" / f"P{number}.jpg", number, size, **exif)
        write_grey(tmp_path / "in" / thermal_name.format(number), number, (96, 72))
    import_files(tmp_path / "in", capture)
    assert {row.width for row in capture.read_frames("rgb")} == {size[0]}
    assert {row.source[0] for row in capture.read_frames("rgb")} == {"P"}
    assert len(capture.read_frames("thermal")) == 5


@pytest.mark.parametrize("make", ["DJI", "FLIR Systems AB"])
def test_pictures_that_a_program_has_saved_again(tmp_path: Path, capture: CaptureFolder, make: str) -> None:
    """Files of makers of radiometric cameras without their values are said to be that."""
    for number in range(5):
        write_photograph(tmp_path / "in" / f"DJI_{number}_W.JPG", number)
        write_grey(tmp_path / "in" / f"DJI_{number}_T.JPG", number, (64, 48), make=make, model="M3T")
    said = " ".join(import_files(tmp_path / "in", capture).sentences)
    assert "5 thermal pictures hold no measured values, though cameras of this maker save them" in said
    assert "a program has saved the pictures again without them" in said


def test_zoomed_photographs_are_taken_where_there_are_no_others(tmp_path: Path, capture: CaptureFolder) -> None:
    """W is chosen beside Z; Z alone is taken, and said to be that."""
    for number in range(5):
        write_photograph(tmp_path / "in" / f"DJI_{number}_Z.JPG", number)
        write_values(tmp_path / "in" / f"DJI_{number}_T.tiff", centikelvin(number))
    assert "The photographs are of the zoom camera" in " ".join(import_files(tmp_path / "in", capture).sentences)
    for number in range(5):
        write_photograph(tmp_path / "in" / f"DJI_{number}_W.JPG", number)
    assert "5 images of the zoom camera" in " ".join(import_files(tmp_path / "in", capture).sentences)
    assert {row.source[-5] for row in capture.read_frames("rgb")} == {"W"}


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        *((suffix, "FLIR") for suffix in (".seq", ".CSQ", ".fff")),
        *((".irg", "InfiRay"), (".is2", "Fluke: SmartView"), (".bmt", "Testo: IRSoft"), (".irb", "InfraTec: IRBIS")),
    ],
)
def test_formats_that_are_not_read(tmp_path: Path, capture: CaptureFolder, suffix: str, words: str) -> None:
    """Alone they are an error, beside others a sentence: whose they are, and what to export."""
    (tmp_path / "in").mkdir()
    for number in range(3):
        (tmp_path / "in" / f"a{number}{suffix}").write_bytes(b"x")
    with pytest.raises(
        UserError, match=r"3 thermal files were not read \(first: a0\..*radiometric JPEGs or 16-bit TIFFs"
    ) as caught:
        import_files(tmp_path / "in", capture)
    for word in words.split(": "):
        assert word in caught.value.message
    write_two_cameras(tmp_path / "in")
    assert "3 thermal files were not read (first: a0" in " ".join(import_files(tmp_path / "in", capture).sentences)


@pytest.mark.parametrize("turn", [90, 270])
def test_frames_that_a_program_turned(tmp_path: Path, capture: CaptureFolder, turn: Any) -> None:
    """One flag turns those whose sides are swapped, of both spectra; without it the error names the flag."""
    folder = write_two_cameras(tmp_path / "in", 7)
    back = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 270: cv2.ROTATE_90_CLOCKWISE}[turn]
    for number in (3, 5):
        turned = cv2.imencode(".jpg", cv2.rotate(scene(number, 96, 72)[..., ::-1], back))[1].tobytes()
        (folder / "visible" / f"VIS_{number:04d}.jpg").write_bytes(turned)
        write_values(folder / "thermal" / f"IR_{number:04d}.tiff", cv2.rotate(centikelvin(number), back))
    with pytest.raises(UserError, match="turned by a program") as caught:
        import_files(folder, capture)
    assert "--turn-back 90" in str(caught.value.hint)
    options = ImportOptions(turn_back=turn, thermal=ThermalOptions(mirror=True))
    said = " ".join(import_files(folder, capture, options).sentences)
    assert f"2 RGB images were turned by {turn}° (first: visible/VIS_0003.jpg)." in said
    assert f"2 thermal images were turned by {turn}°" in said
    assert {(row.width, row.height) for row in capture.read_frames("rgb")} == {(96, 72)}
    assert np.abs(read_image(capture.images("rgb") / "VIS_0005.jpg").astype(int) - scene(5, 96, 72)).mean() < 8
    assert np.array_equal(read_image(capture.images("thermal") / "IR_0005.png"), centikelvin(5)[:, ::-1])


def test_turned_pictures_of_radiometric_files(tmp_path: Path, capture: CaptureFolder) -> None:
    """A program turns the picture, and the values inside stay as the sensor has them: nothing is to be turned."""
    counts = (12_000 + np.arange(36 * 48)).astype(np.uint16).reshape(36, 48)
    for number in range(5):
        shown = scene(number, 36, 48) if number == 2 else scene(number, 48, 36)
        write_flir_jpeg(tmp_path / "in" / f"FLIR{number}.jpg", counts, shown=shown, photograph=scene(number, 96, 72))
    import_files(tmp_path / "in", capture)
    assert {(row.width, row.height) for row in capture.read_frames("thermal")} == {(48, 36)}
