"""A sheet of pairs: photograph, thermal image, and the thermal edges drawn over the photograph."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.checking.plane_warp import PlaneWarp
from thermosplat.thermal.radiometry import FLIR_IRON

Image8 = NDArray[np.uint8]
CELL_WIDTH = 320
"""Width of one picture on the sheet [px]."""
_GAP = 6
_EDGE_COLOR = np.array([0, 255, 120], np.uint8)


def shown_thermal(image: NDArray[Any]) -> Image8:
    """A thermal image as a picture [H, W, 3]: values between their 1% tails in FLIR Iron, pictures as they are."""
    if image.ndim == 3:
        return image
    low, high = np.percentile(image, [1, 99])
    intensity = (image.astype(np.float32) - low) / max(float(high - low), 1e-6)
    return np.rint(255 * FLIR_IRON.to_color(intensity)).astype(np.uint8)


def overlay(photograph: Image8, thermal: Image8, warp: PlaneWarp | None) -> Image8:
    """The photograph with the thermal image's edges over it.

    Args:
        photograph: [H, W, 3].
        thermal: [h, w, 3].
        warp: Where the photograph's pixels are in the thermal image; None: both fill the same frame.
    """
    width, height = CELL_WIDTH, round(CELL_WIDTH * photograph.shape[0] / photograph.shape[1])
    small = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
    if warp is None:
        seen = cv2.resize(thermal, (width, height), interpolation=cv2.INTER_LINEAR)
    else:
        seen = warp.thermal_on_photograph(thermal, width, height)
    grey = cv2.GaussianBlur(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), (0, 0), 1.2)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    strong = strength > max(float(np.percentile(strength, 90)), 4.0)
    drawn = np.rint(0.75 * small).astype(np.uint8)
    drawn[strong] = _EDGE_COLOR
    return drawn


def row(photograph: Image8, thermal: Image8, warp: PlaneWarp | None) -> Image8:
    """One pair: photograph, thermal image, overlay, side by side at one height."""
    last = overlay(photograph, thermal, warp)
    height = last.shape[0]
    parts = [cv2.resize(photograph, (CELL_WIDTH, height), interpolation=cv2.INTER_AREA)]
    width = min(CELL_WIDTH, round(height * thermal.shape[1] / thermal.shape[0]))
    fitted = np.full((height, CELL_WIDTH, 3), 255, np.uint8)
    tall = round(width * thermal.shape[0] / thermal.shape[1])
    left, top = (CELL_WIDTH - width) // 2, (height - tall) // 2
    fitted[top : top + tall, left : left + width] = cv2.resize(thermal, (width, tall), interpolation=cv2.INTER_LINEAR)
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    return np.concatenate([parts[0], gap, fitted, gap, last], axis=1)


def sheet(rows: Sequence[Image8]) -> Image8:
    """All pairs below each other."""
    gap = np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8)
    stacked = [part for one in rows for part in (one, gap)]
    return np.concatenate(stacked[:-1], axis=0)
