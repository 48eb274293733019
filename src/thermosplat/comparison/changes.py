"""What changed between two dates on a grid: a common shift, places that became warmer or colder, things gone or new.

Differences are taken after the common shift, which the weather makes, and only as far as a value lies outside of what
the other date shows within a pixel: edges that are a pixel aside are no change. What pixels differ by that did not
change tells how wide intervals of a difference are: those of both dates are multiplied by one factor, by which 95% of
the differences of a normal distribution with the same median would lie inside. A change is a connected place beyond
its intervals that is far beyond them somewhere, and beyond the intervals of both dates as their own images gave them:
scenes of one date may agree to a tenth of those, and differ by more on what reflects and at what few images saw.

Where heights differ, a thing is gone or new, and its temperature is no change of a temperature. One that is gone here
and one that is new elsewhere, of about the same size and height, have moved.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.comparison.dated_map import DatedMap

Array = NDArray[np.floating]
Kind = Literal["warmer", "colder", "gone", "new", "moved"]
_NORMAL, _MAD = 1.96, 1.4826
_LEAST_FACTOR = 0.1
"""Of the intervals of both dates: scenes that agree exactly, such as one with itself, are not exact. Open choice."""
_CORE = 3.0
"""Times its interval that a change exceeds somewhere: at once, one pixel of 20 lies outside of its own. Open choice."""
_FEWEST_PIXELS = 4
_HEIGHT_PIXELS, _HEIGHT_SCATTERS = 6.0, 3.0
"""A thing that is gone or new is higher than so many pixels are wide, and than so many robust standard deviations of
heights that did not change. Open choice."""
_BESIDE = 5
"""Pixels around a thing that is gone or new whose temperature it makes: it warms the ground and hides it."""
_LOOKS_OTHER = 0.12
"""Colour, of 1, by which a thing changes more than its surroundings, unless its values do by ``_CORE`` intervals: flat
ground without texture has no sure height, and looks as before. Open choice."""
_JOINED = 5
"""Pixels between parts of one change."""
_ALIKE = 0.35
"""Share by which area and height of a thing that moved may differ."""
SEASON = 0.2
"""Share of the grid with other heights from which on it is worth a word: leaves and snow do that."""


@dataclass(frozen=True, eq=False)
class Change:
    """One place that changed."""

    kind: Kind
    """What happened to it; "moved" things are where they are now."""
    mask: NDArray[np.bool_]
    """Its pixels, [H, W]."""
    difference: float
    """Mean difference of values after the common shift, in their unit; of things, of what is seen there."""
    uncertainty: float
    """Half of the 95% interval of a pixel of it, the median."""
    height: float
    """Median change of height [map units]; about 0 where a temperature changed."""
    source: tuple[int, int] | None = None
    """Row and column of where a thing that moved was."""

    @property
    def middle(self) -> tuple[int, int]:
        """Row and column of its middle."""
        rows, columns = np.nonzero(self.mask)
        return round(float(rows.mean())), round(float(columns.mean()))


@dataclass(frozen=True, eq=False)
class Changes:
    """All that changed."""

    shift: float
    """Common difference of values, other date minus first, in their unit."""
    shift_uncertainty: float
    """Half of its 95% interval: it holds what the levels of both cameras did."""
    differences: Array
    """Other minus first minus the shift, [H, W]; NaN where a date shows nothing, or where a thing is gone or new."""
    uncertainties: Array
    """Half of the 95% interval of each difference, [H, W]."""
    found: tuple[Change, ...]
    """The largest first."""
    things_share: float
    """Share of the grid where heights differ."""


def find_changes(first: DatedMap, other: DatedMap, pixel: float) -> Changes:
    """Compare two dates.

    Args:
        pixel: Side of a pixel [map units].
    """
    known = np.isfinite(first.values) & np.isfinite(other.values)
    things, rise = _things(first.heights, other.heights, pixel)
    intervals = np.hypot(first.half_widths, other.half_widths)
    things = _looking_other(things, rise, first, other, intervals)
    beside = cv2.dilate(things.astype(np.uint8), np.ones((2 * _BESIDE + 1,) * 2, np.uint8)) > 0
    still = known & ~beside
    difference = np.where(known, other.values - first.values, np.nan)
    shift = float(np.median(difference[still])) if still.any() else 0.0
    ratios = np.abs(difference - shift)[still] / np.maximum(intervals[still], 1e-9)
    factor = max(_LEAST_FACTOR, _NORMAL * _MAD * float(np.median(ratios))) if still.any() else 1.0
    uncertainties = np.where(known, factor * intervals, np.nan)
    left = _beyond(first.values, other.values - shift)
    beyond = still & (np.abs(left) > uncertainties)
    core = beyond & (np.abs(left) > np.maximum(_CORE * uncertainties, intervals))
    differences = np.where(still, difference - shift, np.nan)
    changed: list[Change] = []
    for sign, kind in ((1, "warmer"), (-1, "colder")):
        for mask in _regions(beyond & (sign * left > 0), core):
            changed.append(_change(kind, mask, differences, uncertainties, rise))
    moved = _moved(
        [
            _change("new" if sign > 0 else "gone", mask, difference - shift, uncertainties, rise)
            for sign in (1, -1)
            for mask in _regions(things & (sign * rise > 0), things, joined=1)
        ]
    )
    found = sorted([*changed, *moved], key=lambda one: -int(one.mask.sum()))
    share = float(things.sum() / max(known.sum(), 1))
    drift = _NORMAL * float(np.hypot(first.drift, other.drift))
    return Changes(shift, drift, differences, uncertainties, tuple(found), share)


def _things(first: Array, other: Array, pixel: float) -> tuple[NDArray[np.bool_], Array]:
    """Where heights differ, and by how much, less what all of them differ by."""
    both = np.isfinite(first) & np.isfinite(other)
    rise = np.where(both, other - first, 0.0)
    if not both.any():
        return both, rise
    rise = np.where(both, rise - np.median(rise[both]), 0.0)
    scatter = _MAD * float(np.median(np.abs(rise[both])))
    least = max(_HEIGHT_PIXELS * pixel, _HEIGHT_SCATTERS * scatter)
    away = np.where(both, _beyond(np.where(both, first, np.nan), first + rise), 0.0)
    return _opened(np.abs(away) > least), rise


def _looking_other(
    things: NDArray[np.bool_], rise: Array, first: DatedMap, other: DatedMap, intervals: Array
) -> NDArray[np.bool_]:
    """The things whose values or colours changed otherwise than those around them."""
    changes = [other.values - first.values]
    if first.photograph is not None and other.photograph is not None:
        changes += list((other.photograph - first.photograph).transpose(2, 0, 1))
    kept = np.zeros_like(things)
    for sign in (1, -1):
        count, labels = cv2.connectedComponents((things & (sign * rise > 0)).astype(np.uint8))
        for number in range(1, count):
            part = _around(labels == number)
            inside = labels[part] == number
            ring = (cv2.dilate(inside.astype(np.uint8), np.ones((2 * _BESIDE + 1,) * 2, np.uint8)) > 0) & ~things[part]
            contrasts = [_contrast(change[part], inside, ring) for change in changes]
            interval = np.nanmedian(intervals[part][inside]) if np.isfinite(intervals[part][inside]).any() else np.inf
            kept[part] |= inside & (contrasts[0] > _CORE * interval / 2 or max(contrasts[1:], default=0) > _LOOKS_OTHER)
    return kept


def _around(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The rows and columns of a mask, and some beside it."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, rows[0] - 2 * _BESIDE), rows[-1] + 2 * _BESIDE + 1),
        slice(max(0, columns[0] - 2 * _BESIDE), columns[-1] + 2 * _BESIDE + 1),
    )


def _contrast(change: Array, inside: NDArray[np.bool_], ring: NDArray[np.bool_]) -> float:
    """By how much more a change inside differs from those around than they do from each other, in the median."""
    parts = [change[mask & np.isfinite(change)] for mask in (inside, ring)]
    if not all(map(len, parts)):
        return 0.0
    within, around = (float(np.median(np.abs(part - np.median(parts[1])))) for part in parts)
    return within - around


def _opened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def _beyond(first: Array, other: Array) -> Array:
    """How far one date lies outside of what the other shows within a pixel, the larger of both ways, [H, W]."""
    there = _outside(other, first)
    back = -_outside(first, other)
    return np.where(np.abs(there) > np.abs(back), there, back)


def _outside(values: Array, others: Array) -> Array:
    """How far values lie above (below: negative) those of the other date around them; 0 where one is not known."""
    around = np.ones((3, 3), np.uint8)
    unknown = ~np.isfinite(others)
    low = cv2.erode(np.where(unknown, np.inf, others).astype(np.float32), around)
    high = cv2.dilate(np.where(unknown, -np.inf, others).astype(np.float32), around)
    known = np.isfinite(values) & np.isfinite(low) & np.isfinite(high)
    away = np.zeros(values.shape)
    away[known] = np.maximum(values - high, 0)[known] + np.minimum(values - low, 0)[known]
    return away


def _regions(mask: NDArray[np.bool_], core: NDArray[np.bool_], joined: int = _JOINED) -> Iterator[NDArray[np.bool_]]:
    """Connected parts of a mask, with what is a little apart, that have a few pixels of the core."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((joined, joined), np.uint8))
    count, labels, facts, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    cores = np.bincount(labels[core & mask], minlength=count)
    for number in range(1, count):
        if cores[number] >= _FEWEST_PIXELS:
            left, upper, width, height, _ = facts[number]
            inside = np.zeros(mask.shape, bool)
            part = slice(upper, upper + height), slice(left, left + width)
            inside[part] = labels[part] == number
            yield inside


def _change(kind: str, mask: NDArray[np.bool_], difference: Array, uncertainty: Array, rise: Array) -> Change:
    known = mask & np.isfinite(difference)
    mean = float(difference[known].mean()) if known.any() else 0.0
    sure = float(np.median(uncertainty[known])) if known.any() else 0.0
    return Change(kind, mask, mean, sure, float(np.median(rise[mask])))  # type: ignore[arg-type]


def _moved(things: list[Change]) -> list[Change]:
    """Things of which one is gone and one like it is new are one that moved: the nearest such."""
    gone, new = ([one for one in things if one.kind == kind] for kind in ("gone", "new"))
    pairs = sorted(
        (float(np.hypot(*np.subtract(old.middle, now.middle))), i, j)
        for i, old in enumerate(gone)
        for j, now in enumerate(new)
        if _alike(old.mask.sum(), now.mask.sum()) and _alike(-old.height, now.height)
    )
    source, target = dict[int, int](), dict[int, int]()
    for _, i, j in pairs:
        if i not in source and j not in target:
            source[i], target[j] = j, i
    rest = [one for i, one in enumerate(gone) if i not in source]
    here = [
        replace(one, kind="moved", source=gone[target[j]].middle) if j in target else one for j, one in enumerate(new)
    ]
    return [*here, *rest]


def _alike(one: float, other: float) -> bool:
    return min(one, other) >= (1 - _ALIKE) * max(one, other)
