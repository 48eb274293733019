"""Warm parts of a view: what is around them, where they end, and which of them are things of their own."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.thermography.hot_regions import Region
from thermosplat.viewer.measuring import SearchedView

Array = NDArray[np.float64]
FEWEST_PIXELS = 9
"""Of a part: 3x3, the least that a radiometric camera measures."""
_SURROUNDINGS = 1 / 3
"""Side of a pixel's surroundings, as a share of the picture's shorter side: a finding fills less than half of it."""
_LEVELS = 255
"""That the values are sorted into for their median, which OpenCV finds in large windows of 8 bits alone."""
_PEAK = 90
"""Percentile of a region's differences that is its full one."""
_LEAST_OWN = 1 / 3
"""Share of a grown region that must stand out of its own like: of roads and lawns a tenth does."""
_LARGE_PART, _COMPACT = 0.25, 0.45
"""Share of a region's pixels, and of the square of its own length, from which on a part is a finding of its own."""


def surroundings(seen: SearchedView) -> Array:
    """The median of each pixel's surroundings, [H, W].

    Args:
        seen: The view.
    """
    values, there = seen.values, seen.there
    if not there.any():
        return np.zeros_like(values)
    low, high = np.percentile(values[there], (0.5, 99.5))
    step = max(float(high - low), 1e-9) / _LEVELS
    filled = np.where(there, values, np.median(values[there]))
    levels = np.rint(np.clip((filled - low) / step, 0, _LEVELS)).astype(np.uint8)
    window = 2 * max(1, round(_SURROUNDINGS * min(values.shape) / 2)) + 1
    median: Array = low + step * cv2.medianBlur(levels, window).astype(np.float64)
    return median


def grown(seen: SearchedView, mask: NDArray[np.bool_], references: Array, sign: float) -> NDArray[np.bool_]:
    """Each part of a mask [H, W] up to where half of its difference is left, without parts of larger surfaces."""
    everything = np.zeros_like(mask)
    labels = cv2.connectedComponents(mask.astype(np.uint8))[1].ravel()
    inside = np.flatnonzero(labels)
    order = inside[np.argsort(labels[inside], kind="stable")]
    signed = np.where(seen.there, sign * seen.values, -np.inf)
    far = np.nan_to_num(signed - sign * references, nan=-np.inf).ravel()
    for pixels in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        if len(pixels) < FEWEST_PIXELS or everything.flat[pixels].all():
            continue
        half = float(np.percentile(far[pixels], _PEAK)) / 2
        whole = _reached(signed > sign * np.median(references.flat[pixels]) + half, pixels)
        if (far[whole] > half).sum() >= _LEAST_OWN * len(whole):
            everything.flat[whole] = True
    return everything


def _reached(mask: NDArray[np.bool_], starts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Pixels [N] of a mask [H, W] that edges of pixels connect with some pixels."""
    image, width = mask.astype(np.uint8), mask.shape[1]
    left = starts[image.flat[starts] == 1]
    while len(left):
        cv2.floodFill(image, None, (int(left[0] % width), int(left[0] // width)), 2, flags=4)
        left = left[image.flat[left] == 1]
    return np.flatnonzero(image == 2)


def compact_parts(
    region: Region, seen: SearchedView, pixels: NDArray[np.bool_]
) -> Iterator[tuple[Region, NDArray[np.bool_]]]:
    """A region; its large parts that are compact, if the view shows some of them with gaps, as two modules have.

    Args:
        region: The region.
        seen: The view.
        pixels: Its pixels there, [H, W].
    """
    count, labels, sizes, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8), connectivity=4)
    shares = sizes[:, cv2.CC_STAT_AREA] / pixels.sum()
    longest = sizes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    compact = sizes[:, cv2.CC_STAT_AREA] >= _COMPACT * longest**2
    large = [part for part in range(1, count) if shares[part] >= _LARGE_PART and compact[part]]
    if len(large) < 2:
        yield region, pixels
        return
    for part in large:
        mine = labels == part
        low, high = np.percentile(seen.points[mine], (2, 98), axis=0)
        area = float(shares[part]) * region.area
        yield replace(region, place=point_of((low + high) / 2), size=point_of(high - low), area=area), mine


def point_of(values: Array) -> tuple[float, float, float]:
    """Coordinates as a tuple."""
    return float(values[0]), float(values[1]), float(values[2])
