"""DJI's radiometric JPEGs: what is read of them without a program, and what is refused; made files, and real ones."""

import os
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_folders import write_photograph
from dji_jpeg import Layout, linear, warm, white_hot, write_dji_jpeg
from thermosplat.errors import UserError
from thermosplat.prepare.importing.dji_files import is_dji_thermal, read_dji

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
REAL = DATA / "real_files"
LINEAR = {
    "H20N_DJI_0001_R.JPG": (5.975, 9.299, 42.225),
    "H30T_DJI_0001_R.JPG": (15.100, 20.360, 91.788),
    "M2EA_DJI_0001_R.JPG": (-3.962, 18.083, 39.912),
    "M30T_DJI_0001_R.JPG": (15.163, 16.455, 23.538),
    "M3T_DJI_0001_R.JPG": (25.475, 30.626, 45.038),
    "M4T_DJI_0001_R.JPG": (-3.212, 14.649, 16.663),
}
"""Minimum, mean and maximum [°C]: stored / 64 - 273.15, which the SDK's own correction leaves as it is where object and
air have one temperature (0.04 °C, see ``dji_files``)."""
COUNTS = {"DJI_H20T.jpg": "DJI ZH20T", "DJI_XTS.jpg": "DJI XT S", "M3TD_DJI_0001_R.JPG": "DJI M3TD"}


def real(name: str) -> Path:
    """A camera's file, or the test is skipped."""
    if not (REAL / name).is_file():
        pytest.skip(f"no real_files/{name} in the shared data folder (THERMOSPLAT_TEST_DATA)")
    return REAL / name


@pytest.mark.parametrize("name", LINEAR)
def test_real_files_with_temperatures(name: str) -> None:
    """They pass every check, and mirrored values do not; emissivity and distance are what DJI's SDK shows."""
    file = read_dji(real(name))
    assert file.holds_temperatures
    celsius = file.celsius()
    assert (celsius.min(), celsius.mean(), celsius.max()) == pytest.approx(LINEAR[name], abs=0.001)
    with pytest.raises(UserError, match="the picture in it shows something else"):
        file.check_picture(celsius[:, ::-1])
    stated = file.parameters
    assert (stated.applied, stated.emissivity, stated.reflected_celsius, stated.humidity) == (False, 0.95, 25.0, 0.5)
    assert stated.distance_metres == (13.0 if "H30T" in name else 5.0)
    assert stated.air_celsius == {"H30T": 21.1875, "M4T_": 16.437}.get(name[:4], 25.0)


@pytest.mark.parametrize("name", COUNTS)
def test_real_files_with_counts(name: str) -> None:
    """They are said to hold none, with the model's name; their pictures show the counts all the same."""
    file = read_dji(real(name))
    assert (file.holds_temperatures, file.model) == (False, COUNTS[name])
    file.check_picture(file.stored.astype(np.float32))


def test_dji_files_are_told_by_maker_and_segments(tmp_path: Path) -> None:
    """The maker, and segments that are large enough for a sensor's values."""
    content = write_dji_jpeg(tmp_path / "a.jpg", linear(warm(1))).read_bytes()
    assert is_dji_thermal(content, "DJI")
    assert is_dji_thermal(content, None)  # EXIF data may be gone
    no_state = content.replace(b"iirp", b"none").replace(b"\xff\xd2\xd1\xff", bytes(4))
    assert not is_dji_thermal(no_state, "FLIR")
    assert not is_dji_thermal(write_photograph(tmp_path / "b.jpg", 1).read_bytes(), "DJI")
    assert not is_dji_thermal(content[:2] + b"\xff\xe3\x00\x04ab" + content[-200:], "DJI")


@pytest.mark.parametrize("layout", ["iirp", "m2ea"])
def test_stored_temperatures(tmp_path: Path, layout: Layout) -> None:
    """Values come back, and what the file states of object and air; nothing of it is applied."""
    file = read_dji(write_dji_jpeg(tmp_path / "a.jpg", linear(warm(1)), layout))
    assert np.abs(file.celsius() - warm(1)).max() <= 1 / 32 + 1e-4
    stated = file.parameters
    assert (stated.emissivity, stated.distance_metres, stated.air_celsius) == (0.95, 5.0, 25.0)
    assert not stated.applied


@pytest.mark.parametrize(
    ("layout", "low_bits"), [("iirp", 1), ("hirp", 0), ("hirp", 3), ("dirp", 2), ("dirp", 0), ("xts", 1)]
)
def test_counts_are_no_temperatures(tmp_path: Path, layout: Layout, low_bits: int) -> None:
    """Low bits that are set, or a layout of another part of the SDK, whatever its values look like."""
    file = read_dji(write_dji_jpeg(tmp_path / "a.jpg", linear(warm(1)) | np.uint16(low_bits), layout))
    assert not file.holds_temperatures
    assert file.parameters.emissivity == (None if layout == "xts" else 0.95)


def test_pictures_of_any_palette(tmp_path: Path) -> None:
    """Black-hot, a rainbow, one that is shifted, one that is enlarged, and one that a program turned."""
    stored = linear(warm(2))
    grey = white_hot(stored)
    rainbow = cv2.applyColorMap(grey[..., 0], cv2.COLORMAP_JET)
    shifted = np.roll(grey, (2, 4), (0, 1))
    for picture in (255 - grey, rainbow, shifted, np.rot90(grey), cv2.resize(grey, None, fx=2, fy=2)):
        file = read_dji(write_dji_jpeg(tmp_path / "a.jpg", stored, picture=np.ascontiguousarray(picture)))
        file.celsius()
    middle = cv2.resize(grey[32:96, 40:120], (160, 128))
    file = read_dji(write_dji_jpeg(tmp_path / "a.jpg", stored, picture=middle, zoom=2.0))
    file.celsius()


@pytest.mark.parametrize("kind", ["another", "mirrored", "upside down", "grey", "noise"])
def test_pictures_of_something_else(tmp_path: Path, kind: str) -> None:
    """Temperatures whose picture shows something else are refused."""
    stored = linear(warm(3))
    pictures = {
        "another": white_hot(warm(4)),
        "mirrored": white_hot(stored)[:, ::-1],
        "upside down": white_hot(stored)[::-1, ::-1],
        "grey": np.full((128, 160, 3), 128, np.uint8),
        "noise": np.random.default_rng(0).integers(0, 255, (128, 160, 3), np.uint8),
    }
    file = read_dji(write_dji_jpeg(tmp_path / "a.jpg", stored, picture=np.ascontiguousarray(pictures[kind])))
    with pytest.raises(UserError, match=r"a\.jpg cannot be right: the picture in it shows something else"):
        file.celsius()


def test_what_else_a_file_says(tmp_path: Path) -> None:
    """The levels of a part of the frame that newer cameras state, and what temperatures are possible at all."""
    stored = linear(warm(5))
    low, high = float(warm(5).min()), float(warm(5).max())
    read_dji(write_dji_jpeg(tmp_path / "a.jpg", stored, levels=(low - 1, 15, high - 2))).celsius()
    for levels in ((low - 10, 15, high), (low, 15, high + 10), (low, high + 20, high)):
        with pytest.raises(UserError, match=r"and the file states -?\d+\.\d °C of a part of them"):
            read_dji(write_dji_jpeg(tmp_path / "a.jpg", stored, levels=levels)).celsius()
    cold = (stored // 8) & np.uint16(0xFFFC)
    with pytest.raises(UserError, match=r"they lie between -2\d\d and -2\d\d °C"):
        read_dji(write_dji_jpeg(tmp_path / "a.jpg", cold.astype(np.uint16))).celsius()


def test_segments_that_are_missing(tmp_path: Path) -> None:
    """A file whose values are cut off or lack a part is refused, and never read as a smaller image."""
    whole = write_dji_jpeg(tmp_path / "a.jpg", linear(np.tile(warm(6), (2, 2)))).read_bytes()
    first = whole.index(b"\xff\xe3")
    second = first + 2 + int.from_bytes(whole[first + 2 : first + 4], "big")
    for content in (whole[:first] + whole[second:], whole[: second + 30_000]):
        (tmp_path / "b.jpg").write_bytes(content)
        with pytest.raises(UserError, match=r"radiometric data in .*b\.jpg is damaged: [\d,]+ bytes are no image"):
            read_dji(tmp_path / "b.jpg")


def test_damaged_files_end_in_sentences(tmp_path: Path) -> None:
    """Random damage gives temperatures that pass the checks, counts, or an error of the user's kind."""
    whole = write_dji_jpeg(tmp_path / "a.jpg", linear(warm(7)), levels=(12, 15, 18)).read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / "b.jpg"
    for _ in range(60):
        content = bytearray(whole[: rng.integers(2, len(whole))] if rng.random() < 0.3 else whole)
        for place in rng.integers(2, len(content), 20):
            content[place] = rng.integers(0, 256)
        path.write_bytes(content)
        with suppress(UserError):
            file = read_dji(path)
            assert not file.holds_temperatures or np.isfinite(file.celsius()).all()
