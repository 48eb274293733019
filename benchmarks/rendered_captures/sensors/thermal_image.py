"""A thermal camera: blur, apparent temperature, noise, a level that drifts, 16-bit counts."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rendered_captures.planck import temperature_of

NETD = 0.05
"""Noise of a pixel [K]."""
BLUR = 0.8
"""Standard deviation of the lens's blur [pixels]."""
_STEP = 4
"""Of stored counts [centikelvin]: below the noise, which would otherwise fill the file."""


def sensed(radiance: NDArray[Any], rng: np.random.Generator) -> NDArray[np.float32]:
    """Apparent temperatures of radiances [W/m^2/sr], [H, W] in deg C."""
    blurred = cv2.GaussianBlur(radiance, (0, 0), BLUR)
    return (temperature_of(blurred) + rng.normal(0, NETD, blurred.shape)).astype(np.float32)


def counts(celsius: NDArray[Any]) -> NDArray[np.uint16]:
    """In centikelvin."""
    whole = np.round((celsius + 273.15) * 100).astype(np.int64)
    return ((whole + _STEP // 2) // _STEP * _STEP).astype(np.uint16)


def drifting_levels(frames: int, rng: np.random.Generator, jump_every: int, span: float | None) -> NDArray[np.float64]:
    """What a camera's level adds to each frame [K]: it drifts upwards, and its shutter sets it anew.

    Args:
        frames: Their number.
        rng: Draws the drift.
        jump_every: Frames between two closings of the shutter; 0: none after the first.
        span: From the lowest level to the highest; None: as it is drawn, which is about 1 K.
    """
    levels = np.zeros(frames)
    level = 0.0
    for k in range(frames):
        starts = k == 0 or (jump_every > 0 and k % jump_every == 0)
        level = rng.normal(0, 0.2) if starts else level + rng.normal(0.03, 0.10)
        levels[k] = level
    if span is not None:
        levels *= span / max(float(np.ptp(levels)), 1e-9)
    return levels
