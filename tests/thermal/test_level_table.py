"""A table of what a function gives for 8-bit colours."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from thermosplat.thermal.level_table import LevelTable
from thermosplat.thermal.radiometry import FLIR_IRON, GREY, Palette


def numbers(levels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A number that tells every colour from all others; float32 holds it."""
    red, green, blue = levels.astype(np.int64).T
    return (red * 65536 + green * 256 + blue).astype(np.float32)


def test_every_colour_has_its_value() -> None:
    """Colours of all cells, in any shape, more than are looked up at once, and none at all."""
    levels = np.random.default_rng(0).integers(0, 256, (300, 700, 3), np.uint8)
    table = LevelTable(numbers)
    np.testing.assert_array_equal(table(levels), numbers(levels.reshape(-1, 3)).reshape(300, 700))
    np.testing.assert_array_equal(table(levels[7, 9]), numbers(levels[7, 9][None])[0])
    assert table(levels[:0]).shape == (0, 700)


def test_a_colour_is_computed_once() -> None:
    """And none that is far from those that occur."""
    asked = []

    def noted(levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        asked.append(len(levels))
        return numbers(levels)

    table = LevelTable(noted)
    levels = np.array([[0, 0, 0], [3, 3, 3], [4, 0, 0], [255, 255, 255]], np.uint8)
    table(levels)
    table(levels[::-1])
    table(np.array([[1, 2, 3], [252, 253, 254]], np.uint8))
    assert asked == [3 * 64]


def test_threads_may_look_up_at_once() -> None:
    """Each gets its own colours' values."""
    images = np.random.default_rng(0).integers(0, 256, (16, 64, 64, 3), np.uint8)
    table = LevelTable(numbers)
    with ThreadPoolExecutor(8) as pool:
        for image, found in zip(images, pool.map(table, images)):
            np.testing.assert_array_equal(found, numbers(image.reshape(-1, 3)).reshape(64, 64))


@pytest.mark.parametrize("palette", [FLIR_IRON, GREY], ids=["iron", "grey"])
def test_large_images_are_inverted_as_small_ones(palette: Palette) -> None:
    """To the bit, whether the table is asked or the curve itself."""
    random = np.random.default_rng(0)
    image = np.rint(255 * palette.to_color(random.random((120, 160)))) + random.integers(-6, 7, (120, 160, 3))
    image = np.clip(image, 0, 255).astype(np.uint8)
    rows = np.stack([palette.to_intensity(row / np.float32(255)) for row in image])
    np.testing.assert_array_equal(palette.to_intensity(image), rows, strict=True)
