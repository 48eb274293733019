"""Noise at all scales, of which the other textures are made."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Color = Sequence[float]
"""Red, green and blue, sRGB, 0 to 255."""


def u8(a: NDArray[Any]) -> Bytes:
    """The values cut off at 0 and 255."""
    return np.clip(a, 0, 255).astype(np.uint8)


def fbm(
    h: int, w: int, rng: np.random.Generator, base: int = 4, octaves: int = 5, gain: float = 0.55, sx: float = 1.0
) -> Floats:
    """Fractal value noise in 0..1; sx > 1 stretches detail horizontally-finer."""
    out, amp = np.zeros((h, w), np.float32), 1.0
    for o in range(octaves):
        g = base * 2**o
        gh, gw = int(np.clip(g, 2, h)), int(np.clip(g * sx * w / h, 2, w))
        out += amp * cv2.resize(rng.standard_normal((gh, gw)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        amp *= gain
    out -= out.min()
    return out / out.max()


def mottle(
    color: Color,
    h: int,
    w: int,
    rng: np.random.Generator,
    amp: float = 0.25,
    fine: float = 6,
    base: int = 4,
    octaves: int = 6,
) -> Bytes:
    """A flat colour with stains at all scales and fine grain: plaster, paint, plastic, asphalt."""
    f = 1 + amp * 2 * (fbm(h, w, rng, base, octaves, 0.65) - 0.5)
    return u8(np.asarray(color, np.float32) * f[..., None] + rng.normal(0, fine, (h, w, 1)))
