"""The size of moving pictures follows what the machine can."""

import pytest

from thermosplat.viewer.pace import LEAST_PIXELS, Pace


def test_a_moving_picture_gets_the_size_that_its_machine_can() -> None:
    """The number of pixels approaches what takes the target's time, whether that is more or fewer."""
    for seconds_per_pixel in (5e-8, 5e-6):
        pace = Pace(target=0.1)
        for _ in range(20):
            width, height = pace.size(1280, 720)
            pace.took(width, height, 0.01 + seconds_per_pixel * width * height)
        width, height = pace.size(1280, 720)
        if seconds_per_pixel == 5e-8:
            assert (width, height) == (1280, 720)
        else:
            assert 0.07 < 0.01 + seconds_per_pixel * width * height < 0.13
        assert width / height == pytest.approx(16 / 9, rel=0.05)
    assert pace.seconds(*pace.size(1280, 720)) == pytest.approx(0.1, rel=0.4)
    assert pace.seconds(1280, 720) > 1.0
    slow = Pace()
    assert slow.seconds(1280, 720) == 0
    for _ in range(20):
        slow.took(*slow.size(1280, 720), 10.0)
    assert slow.pixels == pytest.approx(LEAST_PIXELS, rel=0.01)
