"""Files of one spectrum, with what its folder states of them."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from capture_folders import (
    band8,
    band16,
    centikelvin,
    pseudo_color,
    rgb_image,
    spectra_with,
    temperatures,
    write_colmap_folder,
    write_image,
    write_rgbt_scenes,
)
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError
from tiff_files import tiff_file


@pytest.mark.parametrize("spectrum", ["thermal", "nir"])
def test_an_8_bit_image_among_values(tmp_path: Path, spectrum: str) -> None:
    """Its file is named, and the folder that would do without it."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    for number in range(8):
        write_image(root / "nir" / f"{number:04d}.png", band8(number))
        write_image(root / "nir_raw" / f"{number:04d}.png", band16(number))
    write_image(root / f"{spectrum}_raw" / "0002.png", band8(2))
    with pytest.raises(UserError, match=rf"{spectrum}_raw/0002\.png is an 8-bit image; radiometric") as caught:
        load_capture(root, spectra=spectra_with(nir={}))
    assert "take it out of that folder" in caught.value.hint


def test_colours_of_16_bits_among_values(tmp_path: Path) -> None:
    """They are called what they are."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    write_image(root / "thermal_raw" / "0002.png", rgb_image(2).astype(np.uint16) << 8)
    with pytest.raises(UserError, match=r"0002\.png is an image of 3 channels \(uint16\); radiometric values are"):
        load_capture(root)


def test_each_spectrum_has_its_own_statement(tmp_path: Path) -> None:
    """units.json beside the values, else beside the images; of a spectrum that has a unit it is not read."""
    root = write_colmap_folder(tmp_path)
    for number in range(8):
        for folder in ("thermal", "lwir", "nir"):
            write_image(root / folder / f"{number:04d}.png", centikelvin(temperatures(number)))
    (root / "thermal" / "units.json").write_text('{"unit": "counts"}')
    (root / "lwir" / "units.json").write_text('{"unit": "centi-kelvin"}')
    (root / "nir" / "units.json").write_text("no JSON at all")
    capture = load_capture(
        root,
        spectra=spectra_with(thermal={"folders": ("thermal",)}, lwir={"unit": "auto"}, nir={"unit": "radiance"}),
    )
    assert capture.notes == ()
    views = capture.train[0].views
    assert views["thermal"].values is None
    np.testing.assert_allclose(views["lwir"].values, temperatures(1), atol=0.006)
    np.testing.assert_array_equal(views["nir"].values, centikelvin(temperatures(1)))
    assert [capture.scales[name].measured_unit for name in ("thermal", "lwir", "nir")] == [None, "celsius", "radiance"]


def test_visible_edges_are_told_of_temperatures_alone(tmp_path: Path) -> None:
    """Pseudo-colours that are no temperatures may well look like the photographs."""
    root = write_colmap_folder(tmp_path)
    for number in range(8):
        write_image(root / "thermal" / f"{number:04d}.png", 255 - rgb_image(number))
    (note,) = (note for note in load_capture(root).notes if "MSX" in note)
    assert note.startswith("Thermal images carry visible edges")
    capture = load_capture(root, spectra=spectra_with(thermal={"unit": "index"}))
    assert not any("MSX" in note for note in capture.notes)


def test_a_palette_of_each_spectrum(tmp_path: Path) -> None:
    """The capture's own is for those that name none; a further spectrum is grey unless it says otherwise."""
    root = write_colmap_folder(tmp_path)
    (root / "ironbow_lut.json").write_text(json.dumps({"lut": [[0, 0, 0], [9, 9, 9], [255, 255, 255]]}))
    for number in range(8):
        write_image(root / "thermal" / f"{number:04d}.png", pseudo_color(temperatures(number)))
        write_image(root / "nir" / f"{number:04d}.png", band8(number))
    capture = load_capture(root, spectra=spectra_with(nir={}))
    assert len(capture.scales["thermal"].palette.colors) == 3
    assert len(capture.scales["nir"].palette.colors) == 2
    capture = load_capture(root, spectra=spectra_with(nir={"palette": "iron"}, thermal={"palette": "iron"}))
    assert capture.scales["nir"].palette == capture.scales["thermal"].palette


@pytest.mark.parametrize("which", [range(8), [3]])
@pytest.mark.parametrize("folder", ["images", "thermal"])
def test_images_of_one_value_are_told_of(tmp_path: Path, folder: str, which: list[int]) -> None:
    """A closed shutter, a lens cap: of photographs and of values."""
    root = write_colmap_folder(tmp_path)
    for number in range(8):
        write_image(root / "thermal" / f"{number:04d}.png", centikelvin(temperatures(number)))
    constant = np.zeros((24, 32, 3), np.uint8) if folder == "images" else np.full((24, 32), 29_500, np.uint16)
    for number in which:
        write_image(root / folder / f"{number:04d}.png", constant)
    count, have = ("8 of 8", "have") if len(which) == 8 else ("1 of 8", "has")
    name = "RGB" if folder == "images" else "thermal"
    start = f"{count} {name} images {have} one value everywhere (first: {which[0]:04d}.png): a closed shutter, a"
    assert sum(note.startswith(start) for note in load_capture(root).notes) == 1


def thermal_files(root: Path, values: Callable[[np.ndarray], np.ndarray], fill: float) -> Path:
    """A capture whose thermal TIFFs have a value in place of an eighth of their pixels."""
    write_colmap_folder(root)
    (root / "thermal").mkdir()
    for number in range(8):
        image = values(temperatures(number))
        image[:3] = fill
        (root / "thermal" / f"{number:04d}.tif").write_bytes(tiff_file(image))
    return root


@pytest.mark.parametrize("unit", ["auto", "celsius"])
@pytest.mark.parametrize(
    ("fill", "match"),
    [
        (-9999, r"0000\.tif has 96 pixels without a value: they are not finite numbers or NoData"),
        (-3.4e38, r"0000\.tif has 96 pixels without a value: they are not finite numbers or NoData"),
        (np.nan, r"0000\.tif has 96 pixels without a value: they are not finite numbers or NoData"),
        (-999, r"of the values in thermal/ are -999, and all others can be temperatures"),
    ],
)
def test_values_that_stand_for_none(tmp_path: Path, unit: str, fill: float, match: str) -> None:
    """They are an error, not a range that flattens all others; counts are no advice where °C are stated."""
    root = thermal_files(tmp_path, np.float32, fill)
    with pytest.raises(UserError, match=match) as caught:
        load_capture(root, spectra=spectra_with(thermal={"unit": unit}))
    assert "mask" in caught.value.hint
    assert unit == "auto" or "counts" not in caught.value.hint


@pytest.mark.parametrize("unit", ["auto", "centikelvin"])
def test_zeros_among_temperatures(tmp_path: Path, unit: str) -> None:
    """Of 16-bit values, which a mask may leave out."""
    root = thermal_files(tmp_path, centikelvin, 0)
    with pytest.raises(UserError, match="of the values in thermal/ are 0, and all others can be temperatures"):
        load_capture(root, spectra=spectra_with(thermal={"unit": unit}))
    for number in range(8):
        mask = np.full((24, 32), 255, np.uint8)
        mask[:3] = 0
        write_image(root / "masks" / "thermal" / f"{number:04d}.png", mask)
    low, _ = load_capture(root, spectra=spectra_with(thermal={"unit": unit})).scales["thermal"].range or (0, 0)
    assert low > 10


def test_a_few_cold_pixels_beside_each_other(tmp_path: Path) -> None:
    """Too few for a percentile to see, and no lone dead pixels: nothing is colder than absolute zero."""
    root = thermal_files(tmp_path, np.float32, 25)
    image = np.float32(temperatures(3))
    image[5:8, 5:8] = -500
    (root / "thermal" / "0003.tif").write_bytes(tiff_file(image))
    with pytest.raises(UserError, match=r"0003\.tif has 9 pixels without a value: they lie at absolute zero or below"):
        load_capture(root)


def test_many_values_far_from_all_others(tmp_path: Path) -> None:
    """What may be saturated as well is told of, with the way out."""
    root = thermal_files(tmp_path, centikelvin, 65_535)
    notes = load_capture(root).notes
    assert any("of the thermal values are 65,535, far from all others (28,8" in note for note in notes)
    quiet = load_capture(root, spectra=spectra_with(thermal={"range": (15.0, 35.0)})).notes
    assert not any("far from all others" in note for note in quiet)
