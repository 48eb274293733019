"""Files of one spectrum, with what its folder states of them."""

import json
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
