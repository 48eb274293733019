"""Dead pixels do not set the range of measured values."""

import numpy as np
import pytest

from capture_folders import centikelvin, temperatures, write_colmap_folder, write_image
from thermosplat.datasets import load_capture
from thermosplat.datasets.images.dead_pixels import range_without_dead_pixels


def images(count=3):
    noise = np.random.default_rng(0)
    return [np.float32(temperatures(number) + noise.normal(0, 0.5, (24, 32))) for number in range(count)]


def test_without_dead_pixels_the_range_is_that_of_all_values():
    """To the bit, noise included."""
    clean = images()
    found = range_without_dead_pixels(clean)
    assert (found.low, found.high) == (float(np.min(clean)), float(np.max(clean)))
    assert (found.outside, found.first) == (0, None)


@pytest.mark.parametrize("places", [[(5, 5)], [(0, 0)], [(23, 7), (23, 8)], [(4, 4), (5, 5), (20, 31)]])
@pytest.mark.parametrize("value", [382.2, -273.15])
def test_lone_pixels_are_left_out(places, value):
    """In the middle, at the border, two beside each other: the range is that of the others."""
    dead, clean = images(), range_without_dead_pixels(images())
    for place in places:
        dead[1][place] = value
    found = range_without_dead_pixels(dead)
    assert (found.outside, found.first) == (len(places), 1)
    assert found.low == pytest.approx(clean.low, abs=0.5)
    assert found.high == pytest.approx(clean.high, abs=0.5)


def test_a_hot_spot_is_measured():
    """Nine pixels of a soldering iron are no dead ones."""
    hot = images()
    hot[2][10:13, 10:13] = 300
    assert range_without_dead_pixels(hot).high == 300


def test_one_value_everywhere():
    """There is no range to lie beyond."""
    flat = np.full((8, 8), 20, np.float32)
    flat[3, 3] = 21
    assert range_without_dead_pixels([flat]).high == 21


def test_a_capture_with_a_dead_pixel(tmp_path):
    """Its range is that of the other pixels, and a note names the file."""
    write_colmap_folder(tmp_path)
    for number in range(8):
        values = centikelvin(temperatures(number))
        if number == 3:
            values[5, 6] = 65_535
        write_image(tmp_path / "thermal" / f"{number:04d}.png", values)
    capture = load_capture(tmp_path)
    low, high = capture.scales["thermal"].range
    assert 14.9 < low < high < 35.1
    assert any("1 lone values" in note and "0003.png" in note and "--thermal.range" in note for note in capture.notes)
