"""Where cameras go."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CameraPath = Callable[[int, np.random.Generator], tuple[Array, Array]]
"""From a number of views to where cameras stand and what they look at, each [n, 3] [m]."""
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Between Mitsuba's axes of a camera (x left, y up, z forward) and COLMAP's (x right, y down)."""


def look_at(origin: Array, target: Array) -> Array:
    """Camera to world in Mitsuba's axes, [4, 4]."""
    o, t = np.asarray(origin, float), np.asarray(target, float)
    f = (t - o) / np.linalg.norm(t - o)
    left = np.cross((0, 0, 1.0), f)
    left /= np.linalg.norm(left)
    up = np.cross(f, left)
    c2w = np.eye(4)
    c2w[:3, 0], c2w[:3, 1], c2w[:3, 2], c2w[:3, 3] = left, up, f, o
    return c2w


def camera_orbit(
    n: int,
    rng: np.random.Generator,
    target: Sequence[float],
    radius: float,
    z: float,
    zamp: float,
    zcycles: float,
    jit: float = 0.008,
) -> tuple[Array, Array]:
    """A circle around the target; the height swings by ``zamp`` about ``z``."""
    az = np.radians(360 * np.arange(n) / n)
    ph = 2 * np.pi * zcycles * np.arange(n) / n
    o = np.stack([target[0] + radius * np.cos(az), target[1] + radius * np.sin(az), z + zamp * np.sin(ph)], 1)
    return o + rng.normal(0, jit, (n, 3)), np.asarray(target) + rng.normal(0, jit, (n, 3))


def camera_arc(
    n: int,
    rng: np.random.Generator,
    target: Sequence[float],
    radius: float,
    z: float,
    az0: float,
    az1: float,
    zamp: float,
    jit: float = 0.01,
    slide: float = 0.0,
) -> tuple[Array, Array]:
    """Elliptic sweep: out along the low side and back along the high side of the arc; the target slides a little."""
    t = 2 * np.pi * (np.arange(n) + 0.25) / n
    f = 0.5 - 0.5 * np.cos(t)
    az = np.radians(az0 + (az1 - az0) * f)
    r = radius * (1 + 0.05 * np.sin(2 * t))
    o = np.stack([target[0] + r * np.cos(az), target[1] + r * np.sin(az), z + zamp * np.sin(t)], 1)
    tg = np.asarray(target) + np.stack([slide * (f - 0.5), 0 * f, 0.25 * zamp * np.sin(t)], 1)
    return o + rng.normal(0, jit, (n, 3)), tg + rng.normal(0, jit, (n, 3))
