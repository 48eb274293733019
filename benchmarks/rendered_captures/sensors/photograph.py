"""A digital camera: exposure, noise of photons and of reading, a tone curve, sRGB."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.textures.noise import u8

LUMA = np.float32([0.2126, 0.7152, 0.0722])
"""Rec. 709."""
ELECTRONS, READ_NOISE = 9000.0, 6.0
"""At linear 1, and of reading a pixel."""


def exposure_of(renders: list[NDArray[Any]], key: float) -> float:
    """The factor that gives all renders together the geometric mean ``key``."""
    seen = np.concatenate([(np.clip(render, 0, None) @ LUMA).ravel()[::7] for render in renders])
    return float(key / np.exp(np.log(seen + 1e-5).mean()))


def developed(render: NDArray[Any], exposure: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The photograph of linear radiance [H, W, 3] at an exposure, by a curve like ACES."""
    x = np.clip(render, 0, None) * exposure
    counted = rng.poisson(np.clip(x, 0, 60) * ELECTRONS) + rng.normal(0, READ_NOISE, x.shape)
    x = np.clip(counted / ELECTRONS, 0, None)
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return u8(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) + 0.5)
