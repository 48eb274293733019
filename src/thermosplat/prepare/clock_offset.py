"""The constant difference between the clocks of two cameras, from the times of their images alone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FINEST = 0.05
"""Seconds: no clock in EXIF data is more exact."""
_CANDIDATES = 4000
"""Differences that are tried; of longer lists a part is."""


@dataclass(frozen=True, eq=False)
class ClockOffset:
    """How far the second clock is ahead of the first.

    Args:
        seconds: The constant difference [s].
        partners: [N] index of the second camera's image for each of the first, -1 for none.
        spread: Median distance of the pairs' differences from it [s].
        jumps: Places in the first camera's list after which the difference is another one, with the change [s].
    """

    seconds: float
    partners: NDArray[np.int64]
    spread: float
    jumps: tuple[tuple[int, float], ...]


def find_clock_offset(first: ArrayLike, second: ArrayLike) -> ClockOffset:
    """Find the difference that gives most images a partner, and the partners.

    The tolerance is a quarter of the median time between images of a camera, so that neighbours are not confused. Of
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
    tolerance = max(_FINEST, float(np.median(gaps)) / 4) if gaps.size else 1.0
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
    return ClockOffset(seconds, partners, spread, _jumps(one, two, partners, tolerance))


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


def _jumps(
    one: NDArray[np.float64], two: NDArray[np.float64], partners: NDArray[np.int64], tolerance: float
) -> tuple[tuple[int, float], ...]:
    """Where the images that found no partner would find them with another difference, in long runs."""
    lone_one = np.flatnonzero(partners < 0)
    lone_two = np.setdiff1d(np.arange(len(two)), partners)
    least = max(3, len(one) // 10)
    if min(len(lone_one), len(lone_two)) < least:
        return ()
    rest = find_clock_offset(one[lone_one], two[lone_two])
    if (rest.partners >= 0).sum() < least:
        return ()
    paired = np.flatnonzero(partners >= 0)
    there = lone_one[rest.partners >= 0]
    median = float(np.median(two[partners[paired]] - one[paired])) if len(paired) else 0.0
    if abs(rest.seconds - median) <= tolerance:
        return ()
    at = int(there.min()) if there.min() > paired.min() else int(paired.min())
    return ((at, rest.seconds - median),)
