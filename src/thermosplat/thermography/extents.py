"""How long and how large things are that a picture shows: places on the scene, lengths between them, areas.

Units are those of the depths. A pinhole camera with square or other pixels looks along z; its pixels see the rays
r = (x, y, 1).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermosplat.thermography.shapes import Indices, Place

Array = NDArray[np.float64]
_FLAT = 0.03
"""Distance from a plane (root mean square, of the extent) up to which a surface counts as flat."""
_LEAST_COSINE = 0.2
"""Of what a surface that is not flat is turned away: depths at its edge would make it endless."""


def points_at(places: Sequence[Place], depth: NDArray[np.floating], K: Array, pose: Array) -> list[Array | None]:
    """The points of the scene under places of a picture; None where nothing is.

    Args:
        places: [px].
        depth: z-depths, [H, W], NaN where there is nothing.
        K: The camera's intrinsics, [3, 3].
        pose: Camera to world, [4, 4].
    """
    height, width = depth.shape
    found: list[Array | None] = []
    for x, y in places:
        z = float(depth[min(max(int(y), 0), height - 1), min(max(int(x), 0), width - 1)])
        ray = np.linalg.inv(K) @ np.array([x, y, 1.0])
        found.append(pose[:3, :3] @ (z * ray) + pose[:3, 3] if np.isfinite(z) else None)
    return found


def area_of(pixels: Indices, depth: NDArray[np.floating], K: Array) -> float | None:
    """Area of the surface that pixels show; None where too few of them show any.

    A plane through the surface's points is taken where they lie on one, since depths are noisy: a pixel sees
    z² / (fx fy |n·r|) of a plane with the normal n. Otherwise each pixel has a normal of its own.

    Args:
        pixels: Rows and columns.
        depth: z-depths, [H, W], NaN where there is nothing.
        K: The camera's intrinsics, [3, 3].
    """
    rows, columns = pixels
    z = depth[rows, columns].astype(np.float64)
    there = np.isfinite(z)
    if there.sum() < 6:
        return None
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=-1) @ np.linalg.inv(K).T
    normal, level, distance = _plane((rays * z[:, None])[there])
    extent = float(np.ptp((rays * z[:, None])[there], axis=0).max())
    facing = rays @ normal
    of_pixel = 1 / (K[0, 0] * K[1, 1])
    if distance <= _FLAT * extent and np.abs(facing).min() > 0.02:
        on_plane = level / facing
        return float((of_pixel * on_plane**2 / np.abs(facing)).sum())
    turned = np.abs((_normals(depth, K)[rows, columns] * rays).sum(axis=-1))
    lengths = np.linalg.norm(rays, axis=-1)
    turned = np.maximum(np.nan_to_num(turned, nan=1.0), _LEAST_COSINE * lengths)
    return float(np.where(there, of_pixel * z**2 / turned, 0.0)[there].sum())


def _plane(points: Array) -> tuple[Array, float, float]:
    """Unit normal n, level n·p and distance (root mean square) of the plane through most of the points [P, 3]."""
    kept = points
    for _ in range(3):
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle, full_matrices=False)[2][-1]
        apart = np.abs((points - middle) @ normal)
        limit = 3 * 1.4826 * np.median(apart)
        kept = points[apart <= max(limit, 1e-12)] if (apart <= limit).sum() >= 6 else points
    return normal, float(middle @ normal), float(np.sqrt(np.mean(((points - middle) @ normal) ** 2)))


def _normals(depth: NDArray[np.floating], K: Array) -> Array:
    """Unit normals of a picture's surface, [H, W, 3], in camera axes."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = (np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T) * depth[..., None].astype(np.float64)
    if min(height, width) < 2:
        return np.full((height, width, 3), np.nan)
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)
