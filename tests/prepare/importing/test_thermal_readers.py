"""What is said of thermal files beside their temperatures: limits of the camera, assumptions, what XT cameras state."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_folders import exif_segment, scene, write_photograph
from dji_jpeg import warm, white_hot
from flir_jpeg import write_flir_jpeg
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.importing.thermal_readers import stated
from thermosplat.thermal.planck_counts import RadiometricCamera
from thermosplat.thermal.thermal_parameters import ThermalParameters, parameters_text, read_parameters

CAMERA = RadiometricCamera(16028.2588, 0.084141, 1418.7, 1.15, -10430)
SPAN = {0x98: 423.15, 0x9C: 233.15}
"""-40 to 150 °C."""


def counts_of(celsius: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Counts of black bodies."""
    return np.rint(np.vectorize(lambda value: CAMERA.counts(value + 273.15))(celsius)).astype(np.uint16)


def flight(folder: Path, count: int = 5, **changes: Any) -> Path:
    """FLIR's files of a black body at no distance, with photographs inside; ``changes`` are those of the third."""
    for number in range(count):
        settings: dict[str, Any] = {"camera": {0x20: 1.0, 0x24: 0.0, **SPAN}, "photograph": scene(number, 96, 72)}
        settings |= changes if number == 2 else {}
        celsius = settings.pop("celsius", warm(number)[:36, :48])
        write_flir_jpeg(folder / f"FLIR{number:04d}.jpg", counts_of(celsius), **settings)
    return folder


def imported(folder: Path, root: Path) -> tuple[CaptureFolder, str]:
    """The capture, and what was said."""
    capture = CaptureFolder(root)
    return capture, " ".join(import_files(folder, capture).sentences)


def test_a_saturated_row_has_no_temperature(tmp_path: Path) -> None:
    """Few counts beyond the camera's limits get their neighbours' temperature, and that is said."""
    celsius = warm(2)[:36, :48].copy()
    celsius[35, 30:40] = 303
    capture, said = imported(flight(tmp_path / "in", celsius=celsius), tmp_path / "out")
    assert (
        "10 pixels of 1 file lie outside the -40 to 150 °C that the camera can measure (first: FLIR0002.jpg, 303"
        in said
    )
    assert "10 pixels without a temperature were filled" in said
    stored = read_image(capture.images("thermal") / "FLIR0002.png") / 100 - 273.15
    assert stored.max() < 60


def test_a_cold_sky_stays(tmp_path: Path) -> None:
    """Much below the limit is said and kept; a file that lies outside as a whole is refused."""
    celsius = warm(2)[:36, :48].copy()
    celsius[:9] = -62
    capture, said = imported(flight(tmp_path / "in", celsius=celsius), tmp_path / "out")
    assert "432 pixels of 1 file lie outside" in said
    assert "-62 °C): clear sky, or a saturated sensor" in said
    assert read_image(capture.images("thermal") / "FLIR0002.png").min() / 100 - 273.15 == pytest.approx(-62, abs=0.1)
    with pytest.raises(UserError, match=r"FLIR0002.jpg cannot be right: 100% lie outside"):
        imported(flight(tmp_path / "in2", celsius=celsius + 300), tmp_path / "out2")


def test_assumptions_of_all_files_are_said_and_kept(tmp_path: Path) -> None:
    """From which to which emissivity and distance, and each file's own in thermal_parameters.json."""
    changes = {"camera": {0x20: 0.8, 0x24: 4.0, 0x28: 300.0, **SPAN}}
    capture, said = imported(flight(tmp_path / "in", **changes), tmp_path / "out")
    assert "for an emissivity of 0.80 to 1.00, 22 to 27 °C reflected and 0.0 to 4.0 m, as each file says" in said
    kept = read_parameters(capture.thermal_parameters)
    assert [one.emissivity for one in kept.values()] == pytest.approx([1, 1, 0.8, 1, 1])
    third = kept["FLIR0002.png"]
    assert third.applied
    assert third.planck == pytest.approx({"r1": 16028.2588, "r2": 0.084141, "b": 1418.7, "f": 1.15, "o": -10430})
    assert (third.air or {})["x"] == pytest.approx(1.9)
    assert (third.distance_metres, third.humidity) == (4.0, 0.5)


def test_photographs_inside_some_files(tmp_path: Path) -> None:
    """The first file without one does not hide the others'; too few are an error with the first that lacks it."""
    capture, said = imported(flight(tmp_path / "in", 7, photograph=None), tmp_path / "out")
    assert "1 of 7 radiometric files has no photograph inside (first: FLIR0002.jpg)." in said
    assert len(capture.read_frames("rgb")) == 6
    for number in range(3):
        write_flir_jpeg(tmp_path / "in" / f"FLIR{number:04d}.jpg", counts_of(warm(1)[:36, :48]), camera=SPAN)
    with pytest.raises(UserError, match=r"4 of 7 radiometric files have a photograph inside \(first without: FLIR0000"):
        imported(tmp_path / "in", tmp_path / "out2")


def xmp_segment(fields: str) -> bytes:
    """XMP as DJI writes it."""
    packet = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {fields}></rdf:Description></x:xmpmeta>'
    body = b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


@pytest.mark.parametrize(
    ("temperature", "mirrored", "pattern"),
    [
        (0, False, ""),
        (1, False, r"the middle has [\d.]+ to [\d.]+ °C, and the file states"),
        (0, True, "shows something else"),
    ],
)
def test_xt_cameras_are_held_against_their_xmp_and_picture(
    tmp_path: Path, temperature: float, mirrored: bool, pattern: str
) -> None:
    """The middle's temperature in XMP, and the picture: DJI's files with FLIR's counts inside."""
    for number in range(5):
        celsius = warm(number)
        shown = white_hot(celsius)[:, ::-1] if mirrored and number == 3 else white_hot(celsius)
        path = tmp_path / "in" / f"DJI_{number:04d}_R.jpg"
        settings: dict[str, Any] = {"shown": np.ascontiguousarray(shown), "camera": {0x20: 1.0, 0x24: 0.0, **SPAN}}
        content = write_flir_jpeg(path, counts_of(celsius), **settings).read_bytes()
        middle = round(float(celsius[62:66, 78:82].mean())) + (20 * temperature if number == 3 else 0)
        xmp = xmp_segment(f'FLIR:CentralTemperature="{middle}"')
        path.write_bytes(content[:2] + exif_segment(make="DJI", model="FLIR") + xmp + content[2:])
        write_photograph(tmp_path / "in" / f"DJI_{number:04d}.jpg", number)
    if not pattern:
        imported(tmp_path / "in", tmp_path / "out")
        return
    with pytest.raises(UserError, match=rf"DJI_0003_R\.jpg cannot be right: .*{pattern}"):
        imported(tmp_path / "in", tmp_path / "out")


def test_parameters_survive_their_file(tmp_path: Path) -> None:
    """Written and read; none without a file; a damaged file is named."""
    some = {
        "a.png": ThermalParameters.of_camera(CAMERA),
        "b.png": ThermalParameters(applied=False, emissivity=0.9),
    }
    path = tmp_path / "thermal_parameters.json"
    assert read_parameters(path) == {}
    path.write_text(parameters_text(some))
    assert read_parameters(path) == some
    assert stated(list(some.values())) == "an emissivity of 0.90 to 1.00, 20 °C reflected and 0.0 m"
    for damage in ("[]", "{", '{"images": {"a": {}}}', '{"images": {"a": {"applied": true, "emissivity": "NaN"}}}'):
        path.write_text(damage)
        with pytest.raises(UserError, match=r"thermal_parameters\.json is damaged"):
            read_parameters(path)
