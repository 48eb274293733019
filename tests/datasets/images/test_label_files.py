"""Label images as files: grey levels are classes, 255 is none, and nothing lies between two."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.class_colors import colors_of
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.spectrum_files import read_spectrum
from thermosplat.datasets.images.spectrum_images import SpectrumReading
from thermosplat.datasets.lens import Lens
from thermosplat.datasets.stored_pixels import seen_by
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig

SETTINGS = SpectrumConfig(source="labels", classes=("wall", "window", "door"))


def read(path: Path, image: np.ndarray) -> SpectrumReading:
    """The reading of one label image."""
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    shot = Shot(path, Lens("PINHOLE", (9.0, 9.0, 4.0, 3.0), 8, 6), np.eye(4))
    listing = Listing("colmap", (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    reading = read_spectrum(path.parent, "labels", SETTINGS, [FrameFiles("a", {"labels": shot})], listing)
    assert reading is not None
    return reading


def test_levels_are_classes(tmp_path: Path) -> None:
    """Classes have their colours; pixels of none do not count; smaller images have no colour that is no class's."""
    numbers = np.zeros((6, 8), np.uint8)
    numbers[:, 3:] = 2
    numbers[0, 0] = 255
    (pixels,) = read(tmp_path / "a.png", numbers).pixels
    assert pixels is not None
    assert pixels.mask is not None
    np.testing.assert_array_equal(pixels.mask, numbers != 255)
    np.testing.assert_array_equal(pixels.image[1], np.stack(colors_of(numbers[1]), axis=-1))
    smaller = seen_by(Camera(4.5, 4.5, 2.0, 1.5, 4, 3), None, pixels)
    assert set(map(tuple, smaller.image[1:].reshape(-1, 3).tolist())) == {(0, 0, 0), (0, 128, 0)}


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.full((6, 8), 3, np.uint8), r"a.png has pixels of class 3, and the spectrum has 3 classes \(0 to 2\)"),
        (np.zeros((6, 8, 3), np.uint8), "a.png is no label image"),
        (np.zeros((6, 8), np.uint16), "a.png is no label image"),
    ],
    ids=["unknown class", "colours", "16 bits"],
)
def test_what_is_no_label_image_is_refused(tmp_path: Path, image: np.ndarray, expected: str) -> None:
    """A class without a name, colours and values are errors that name the file."""
    with pytest.raises(UserError, match=expected):
        read(tmp_path / "a.png", image)
