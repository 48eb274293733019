"""How wide intervals must be so that they hold 95% of what was not trained on (split conformal prediction: Vovk,
Gammerman and Shafer 2005).

A held-out view is wrong by a level, which is one number for all its pixels where the sensor drifts, and by what is left
pixel by pixel. A handful of held-out views has many pixels and few levels. So levels are those of training views too,
whose own level no scene shows, and a factor is the quantile of every level added to every pixel's error.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.regular_files import read_regular

Array = NDArray[np.float64]
SHARE = 0.95
"""Of pixels, that intervals are to hold."""
_BINS = 4
"""Of s, each with a factor of its own."""
_SAMPLES = 5000
"""Most pixels of a bin that levels are added to."""
_UNKNOWN = 2.0
"""The factor where no held-out view tells: 95% of a normal distribution."""


@dataclass(frozen=True)
class Calibration:
    """What held-out views say of a scene's temperatures."""

    noise: float
    """Standard deviation of the sensor's noise, in the unit of the values."""
    level: float
    """Standard deviation of the level from image to image that the scene does not explain."""
    edges: tuple[float, ...]
    """Ends of the bins of s."""
    factors: tuple[float, ...]
    """Half of the interval in each bin, in s; one more than edges."""

    def half_width(self, s: Array) -> Array:
        """Half of the interval for each s."""
        return np.asarray(np.asarray(self.factors)[np.searchsorted(self.edges, s)] * s, np.float64)


def calibration(noise: float, levels: Array, views: Sequence[tuple[Array, Array]]) -> Calibration:
    """A calibration by views that were not trained on.

    Args:
        noise: Standard deviation of the sensor's noise.
        levels: What training views are wrong by as a whole, [V].
        views: Of each held-out view, s and signed errors of the pixels that have both, each [N].
    """
    views = [(s, errors) for s, errors in views if len(s)]
    own = [float(np.median(errors)) for _, errors in views]
    spread = float(np.std(levels)) if len(levels) else 0.0
    if sum(len(s) for s, _ in views) < 100:
        return Calibration(noise, spread, (), (_UNKNOWN,))
    size = np.concatenate([s for s, _ in views])
    left = np.concatenate([errors - level for (_, errors), level in zip(views, own, strict=True)])
    every = np.concatenate([levels, own])
    edges = np.quantile(size, np.linspace(0, 1, _BINS + 1)[1:-1])
    of_bin = np.searchsorted(edges, size)
    factors = []
    for k in range(_BINS):
        mine = np.flatnonzero(of_bin == k)
        mine = mine[:: max(1, len(mine) // _SAMPLES)]
        ratios = np.abs(left[mine, None] + every) / np.maximum(size[mine, None], 1e-12)
        factors.append(float(np.quantile(ratios, SHARE)) if ratios.size else _UNKNOWN)
    return Calibration(noise, spread, tuple(map(float, edges)), tuple(factors))


def read_calibration(path: Path) -> Calibration | None:
    """A calibration that was kept; None where there is none that can be read."""
    try:
        stated = json.loads(read_regular(path))
        edges, factors = (tuple(map(float, stated[name])) for name in ("edges", "factors"))
        made = Calibration(float(stated["noise"]), float(stated["level"]), edges, factors)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sound = len(factors) == len(edges) + 1 and all(map(math.isfinite, (*edges, *factors, made.noise, made.level)))
    return made if sound else None
