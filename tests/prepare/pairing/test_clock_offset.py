"""Two cameras' clocks."""

import numpy as np
import pytest

from thermosplat.prepare.pairing.clock_offset import find_clock_offset

TIMES = np.cumsum(np.random.default_rng(3).uniform(2, 9, 40))
"""When 40 images were taken [s]."""


@pytest.mark.parametrize("offset", [0.0, -0.9, 3601.25, -86_400.0])
def test_constant_difference(offset: float) -> None:
    """It is found from times alone, with noise, and every image gets its partner."""
    noise = np.random.default_rng(4).normal(0, 0.05, len(TIMES))
    found = find_clock_offset(TIMES, TIMES + offset + noise)
    assert found.seconds == pytest.approx(offset, abs=0.05)
    assert np.array_equal(found.partners, np.arange(len(TIMES)))
    assert found.spread < 0.1
    assert found.jumps == ()


def test_missing_images() -> None:
    """Images that one camera lacks stay without a partner and do not shift the others'."""
    kept = np.setdiff1d(np.arange(40), [0, 7, 8, 30])
    found = find_clock_offset(TIMES, TIMES[kept] + 12.5)
    assert found.seconds == pytest.approx(12.5)
    assert np.array_equal(np.flatnonzero(found.partners < 0), [0, 7, 8, 30])
    assert np.array_equal(kept[found.partners[kept]], kept)


@pytest.mark.parametrize("jump", [63.0, 5000.0, -5000.0])
@pytest.mark.parametrize("first", [8, 25])
def test_clock_that_jumps(first: int, jump: float) -> None:
    """Both parts are paired, and where and how far the clock jumps is said; a clock that is set back, too."""
    moments = TIMES + np.where(np.arange(40) < first, 2.0, 2.0 + jump)
    order = np.argsort(moments)
    found = find_clock_offset(TIMES, moments[order])
    assert (order[found.partners] == np.arange(40)).all()
    ((place, change),) = found.jumps
    assert place == first
    assert change == pytest.approx(jump, abs=0.1)


def test_scattered_images_are_no_part_beyond_a_jump() -> None:
    """Images that either camera lacks here and there are not paired with each other by another difference."""
    first, second = np.setdiff1d(np.arange(40), range(0, 40, 5)), np.setdiff1d(np.arange(40), range(2, 40, 5))
    found = find_clock_offset(TIMES[first], TIMES[second])
    assert found.jumps == ()
    assert (found.partners >= 0).sum() == len(np.intersect1d(first, second))


def test_one_image_each_is_a_pair() -> None:
    """One image each is a pair."""
    assert find_clock_offset([5.0], [9.0]).partners.tolist() == [0]
