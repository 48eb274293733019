"""The constant difference between the clocks of two cameras, from the times of their images alone."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FINEST, _WHOLE_SECOND = 0.05, 1.0
"""Seconds: no clock in EXIF data is more exact. Whole seconds of two clocks differ by one from moment to moment."""
_CANDIDATES = 4000
"""Differences that are tried; of longer lists a part is."""
_SHORTEST_RUN, _GAPS_IN_RUN = 4, 1.5
"""Images beyond a jump of a clock: at least so many, in a run that is at most so many times as long."""


@dataclass(frozen=True, eq=False)
class ClockOffset:
    """How far the second clock is ahead of the first.

    Args:
        seconds: The constant difference [s].
        partners: [N] index of the second camera's image for each of the first, -1 for none.
        spread: Median distance of the pairs' differences from it [s].
        jumps: Places in the first camera's list from which on the difference is another one, with the change [s]. The
            images there have their partners by that difference.
    """

    seconds: float
    partners: NDArray[np.int64]
    spread: float
    jumps: tuple[tuple[int, float], ...]


def find_clock_offset(first: ArrayLike, second: ArrayLike) -> ClockOffset:
    """Find the difference that gives most images a partner, and the partners.

    The tolerance is a quarter of the median time between images of a camera, so that neighbours are not confused, and a
    second where that is the smallest step of the clocks. Of
    differences with equally many pairs the one with the smallest residuals wins, and of those the smallest difference.

    Args:
        first: Times of the first camera's images [s], ascending.
        second: The same of the second camera.

    Returns:
        The difference and the pairs, in which each image is at most once.
    """
    one, two = np.asarray(first, np.float64), np.asarray(second, np.float64)
    gaps = np.concatenate([np.diff(one), np.diff(two)])
    gaps = gaps[gaps > 0]
    whole = bool((one == np.rint(one)).all() and (two == np.rint(two)).all())
    finest = _WHOLE_SECOND if whole else _FINEST
    tolerance = max(finest, float(np.median(gaps)) / 4) if gaps.size else 1.0
    differences = (two[None, :] - one[:, None]).ravel()
    if differences.size > _CANDIDATES:
        differences = np.sort(differences)[:: -(-differences.size // _CANDIDATES)]
    best = max(
        differences,
        key=lambda candidate: (*_quality(one, two, candidate, tolerance), -abs(candidate)),
    )
    partners = _partners(one, two, best, tolerance)
    paired = partners >= 0
    residuals = two[partners[paired]] - one[paired]
    seconds = float(np.median(residuals))
    partners = _partners(one, two, seconds, tolerance)
    paired = partners >= 0
    residuals = two[partners[paired]] - one[paired]
    spread = float(np.median(np.abs(residuals - seconds))) if paired.any() else 0.0
    return _beyond_a_jump(one, two, ClockOffset(seconds, partners, spread, ()), tolerance)


def _quality(one: NDArray[np.float64], two: NDArray[np.float64], offset: float, tolerance: float) -> tuple[int, float]:
    """Number of images with a partner, and minus the mean distance of the pairs."""
    partners = _partners(one, two, offset, tolerance)
    paired = partners >= 0
    count = int(paired.sum())
    distance = float(np.abs(two[partners[paired]] - one[paired] - offset).mean()) if count else np.inf
    return count, -distance


def _partners(one: NDArray[np.float64], two: NDArray[np.float64], offset: float, tolerance: float) -> NDArray[np.int64]:
    """For each image of the first camera the nearest one of the second, if each is the other's nearest."""
    shifted = two - offset
    nearest = _nearest(one, shifted)
    back = _nearest(shifted, one)
    mutual = back[nearest] == np.arange(len(one))
    near = np.abs(shifted[nearest] - one) <= tolerance
    return np.where(mutual & near, nearest, -1)


def _nearest(times: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(others, times), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(others[before] - times) <= np.abs(others[after] - times), before, after)


def _beyond_a_jump(
    one: NDArray[np.float64], two: NDArray[np.float64], found: ClockOffset, tolerance: float
) -> ClockOffset:
    """The pairs with those that another difference gives to one long run of images without a partner."""
    lone_one = np.flatnonzero(found.partners < 0)
    lone_two = np.setdiff1d(np.arange(len(two)), found.partners)
    least = max(_SHORTEST_RUN, len(one) // 10)
    if min(len(lone_one), len(lone_two)) < least:
        return found
    rest = find_clock_offset(one[lone_one], two[lone_two])
    there = lone_one[rest.partners >= 0]
    change = rest.seconds - found.seconds
    if len(there) < least or abs(change) <= tolerance or np.ptp(there) >= _GAPS_IN_RUN * len(there):
        return found
    paired = np.flatnonzero(found.partners >= 0)
    later = bool(np.median(there) > np.median(paired))
    beyond = np.arange(there.min(), len(one)) if later else np.arange(there.max() + 1)
    partners = found.partners.copy()
    partners[beyond] = -1  # single images meet a partner by chance
    others = _partners(one[beyond], two, rest.seconds, tolerance)
    partners[beyond] = np.where(np.isin(others, partners[partners >= 0]), -1, others)
    jump = (int(beyond[0]), change) if later else (len(beyond), -change)
    return replace(found, partners=partners, jumps=(jump,))
