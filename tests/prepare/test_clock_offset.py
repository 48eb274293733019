"""Two cameras' clocks."""

import numpy as np
import pytest

from thermosplat.prepare.clock_offset import find_clock_offset

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


def test_clock_that_jumps() -> None:
    """The larger part is paired, and where and how far the clock jumps is said."""
    second = TIMES + np.where(np.arange(40) < 25, 2.0, 65.0)
    found = find_clock_offset(TIMES, second)
    assert found.seconds == pytest.approx(2.0)
    assert (found.partners[:25] == np.arange(25)).all()
    ((place, change),) = found.jumps
    assert abs(place - 25) <= 1
    assert change == pytest.approx(63.0, abs=0.1)


def test_few_images() -> None:
    """One image each is a pair."""
    assert find_clock_offset([5.0], [9.0]).partners.tolist() == [0]
