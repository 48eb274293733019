"""8-bit images of renders, measured values and errors."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.pictures.image_display import (
    error_bytes,
    fitted,
    resized,
    rgb_bytes,
    side_by_side,
    spectrum_bytes,
    write_png,
)
from thermosplat.thermal.radiometry import FLIR_IRON, GREY, PixelScale


def test_colors_are_clamped_and_rounded() -> None:
    """0 to 1 becomes 0 to 255, to the nearest level; what lies outside is clamped."""
    image = np.array([[[-0.5, 0.0, 0.5], [1.0, 1.7, 100.4 / 255]]])
    np.testing.assert_array_equal(rgb_bytes(image), [[[0, 0, 128], [255, 255, 100]]])


def test_scalars_are_shown_through_their_palette() -> None:
    """A scalar becomes the palette's colour; photographs and pseudo-colours are shown as they are."""
    intensity = np.array([[[0.0], [0.5], [1.2]]], np.float32)
    shown = spectrum_bytes(intensity, PixelScale("scalar", FLIR_IRON, None))
    np.testing.assert_array_equal(shown, rgb_bytes(FLIR_IRON.to_color(np.array([[0.0, 0.5, 1.0]]))))
    grey = spectrum_bytes(intensity, PixelScale("scalar", GREY, (0.0, 1.0), "reflectance"))
    np.testing.assert_array_equal(grey, [[[0] * 3, [128] * 3, [255] * 3]])
    color = np.full((1, 2, 3), 0.2)
    for scale in (PixelScale("color", FLIR_IRON, None), PixelScale("photograph")):
        np.testing.assert_array_equal(spectrum_bytes(color, scale), rgb_bytes(color))


def test_error_palette_brightens() -> None:
    """More error is brighter, up to the largest, and black is none."""
    shown = error_bytes(np.array([[0.0, 0.1, 0.2, 0.4, 9.0]]), largest=0.4).astype(int).sum(axis=-1)[0]
    assert shown[0] < 10
    assert (np.diff(shown[:4]) > 0).all()
    assert shown[3] == shown[4]


@pytest.mark.filterwarnings("error")
def test_error_palette_of_a_capture_with_one_value() -> None:
    """With a range of 0 no error is black and any error is at the bright end, without a warning."""
    shown = error_bytes(np.array([[0.0, 0.1]]), largest=0.0)
    expected = error_bytes(np.array([[0.0, 1.0]]), largest=1.0)
    np.testing.assert_array_equal(shown, expected)


def test_png_keeps_rgb_order(tmp_path: Path) -> None:
    """What is written reads back with the same colours in RGB order."""
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "new" / "image.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "image.png"))[..., ::-1], image)


def test_side_by_side_scales_to_the_left_height() -> None:
    """Images of different size get one height, that of the first, each keeping its aspect; one stays as it is."""
    left, right = np.zeros((30, 40, 3), np.uint8), np.full((10, 20, 3), 9, np.uint8)
    both = side_by_side([left, right])
    assert both.shape == (30, 40 + 60, 3)
    assert (both[:, 40:] == 9).all()
    three = side_by_side([right, left, right])
    assert three.shape == (10, 20 + 13 + 20, 3)
    assert (three[:, 33:] == 9).all()
    np.testing.assert_array_equal(side_by_side([right]), right)


def test_enlarging_keeps_pixels_sharp() -> None:
    """An enlarged image has no colours that the small one lacks."""
    image = np.array([[[0, 0, 0], [255, 255, 255]]], np.uint8)
    assert set(np.unique(resized(image, 8, 4))) == {0, 255}


def test_fitted_images_keep_their_proportions() -> None:
    """A wide image gets bars above and below, a narrow one at its sides; one of the same proportions none."""
    white = np.full((2, 4, 3), 255, np.uint8)
    wide = fitted(white, 8, 8)
    assert wide.mean(axis=(1, 2)).tolist() == [0, 0, 255, 255, 255, 255, 0, 0]
    narrow = fitted(white, 12, 4)
    assert narrow.mean(axis=(0, 2)).tolist() == [0, 0, *[255] * 8, 0, 0]
    assert (fitted(white, 2, 1) == 255).all()
