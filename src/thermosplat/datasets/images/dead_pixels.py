"""The range of measured values without dead pixels, of which one alone would flatten all images."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

DEAD_WINDOW = 3
"""Side of the median's window [px]: up to four pixels in nine, or two in a corner, do not reach it."""
_BEYOND = 1.0
"""Share of the range of the medians by which a value must lie beyond it to be left out. Open choice: noise and edges
stay within, so that a range without dead pixels is that of all values, to the bit."""

_MANY = 0.002
"""Share of values that are no dead pixels any more. Open choice."""


@dataclass(frozen=True)
class ValueRange:
    """Least and largest value, and where values beyond them are.

    Args:
        low: Least value.
        high: Largest value.
        outside: How many values lie beyond.
        first: Number of the first image that has one; None: there are none.
    """

    low: float
    high: float
    outside: int = 0
    first: int | None = None


def range_without_dead_pixels(images: Iterable[NDArray[np.float32]]) -> ValueRange:
    """Extremes of all images, without lone pixels that lie further out than the range of the others is wide.

    Args:
        images: Measured values, each [H, W] float32, finite; gone through twice, one in memory at a time.
    """
    smooth = [_ends(cv2.medianBlur(np.ascontiguousarray(image), DEAD_WINDOW)) for image in images]
    inner_low, inner_high = min(low for low, _ in smooth), max(high for _, high in smooth)
    width = inner_high - inner_low
    least, most = (inner_low - _BEYOND * width, inner_high + _BEYOND * width) if width > 0 else (-np.inf, np.inf)
    ends, outside = [], []
    for image in images:
        inside = image[(image >= least) & (image <= most)]
        outside.append(image.size - inside.size)
        if inside.size:
            ends.append(_ends(inside))
    return ValueRange(
        min(low for low, _ in ends),
        max(high for _, high in ends),
        sum(outside),
        next((number for number, count in enumerate(outside) if count), None),
    )


def far_value(values: NDArray[Any]) -> float | None:
    """The lowest or highest value, if many have it and it lies further from the others than these from each other.

    Args:
        values: [N].
    """
    for end in (values.min(), values.max()):
        others = values[values != end].astype(np.float64)
        if 0 < len(others) <= (1 - _MANY) * len(values):
            gap = np.abs(others - float(end)).min()
            if gap > _BEYOND * np.ptp(others) > 0:
                return float(end)
    return None


def _ends(values: NDArray[np.float32]) -> tuple[float, float]:
    return float(values.min()), float(values.max())
