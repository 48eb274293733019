"""What surrounds a scene: maps by latitude and longitude, row 0 is the zenith."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.textures.noise import Color, Floats, fbm


def sky_rgb(
    rng: np.random.Generator,
    zenith: Color,
    horizon: Color,
    cloud: float = 0.5,
    ground: Color = (0.25, 0.24, 0.22),
    h: int = 256,
) -> Floats:
    """Linear radiance of a sky with clouds, [h, 2h, 3]."""
    el = np.linspace(np.pi / 2, -np.pi / 2, h)[:, None]
    t = np.clip(np.sin(el), 0, 1)[..., None] ** 0.5
    img = (1 - t) * np.array(horizon) + t * np.array(zenith) + np.zeros((h, 2 * h, 1))
    c = np.clip((fbm(h, 2 * h, rng, 5, 6, 0.6) - 0.48) * 3, 0, 1)[..., None] * cloud
    img = img * (1 - c) + c * 1.25 * np.array(horizon).max()
    img[h // 2 :] = ground
    return img.astype(np.float32)


def sky_T(zenith: float = -22.0, horizon: float = 9.0, ground: float = 16.0, h: int = 64) -> NDArray[Any]:
    """Apparent temperatures of a clear sky [deg C], [h, 2h]."""
    el = np.linspace(np.pi / 2, -np.pi / 2, h)[:, None]
    t = np.where(el > 0, horizon + (zenith - horizon) * np.clip(np.sin(el), 0, 1) ** 0.6, ground)
    return np.repeat(t, 2 * h, 1)
