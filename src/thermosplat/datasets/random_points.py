"""Starting points of captures whose poses are known without a point cloud."""

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.cameras import FARTHEST_CAMERA

MIN_POINTS = 4
"""A Gaussian's first scale comes from the three nearest neighbours of its point."""
_RANDOM_POINTS = 50_000
"""As many as nerfstudio's splatfacto starts with."""
_RANDOM_RADIUS = 3.0
"""Half the side of the box of random points, in camera-to-centre distances (gsplat's trainer: init_extent 3)."""
STARTING_RANDOM = f"starting from {_RANDOM_POINTS:,} random points around the cameras."
"""The end of the note that says so."""


def starting_places(points: NDArray[np.float64]) -> int:
    """In how many places points lie, counted up to ``MIN_POINTS``: many points in one place are one to start from.

    Args:
        points: [M, 3]; those that are not finite do not count.
    """
    rest, places = points[np.isfinite(points).all(axis=-1)], 0
    while len(rest) and places < MIN_POINTS:
        rest, places = rest[(rest != rest[0]).any(axis=1)], places + 1
    return places


def random_points(centers: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Uniform points [M, 3] of random colours [M, 3] uint8 in a cube around the cameras, the same ones every time.

    Args:
        centers: [N, 3] positions of the cameras [world units]; impossible ones, which are told later, do not count.
    """
    centers = centers[(np.abs(centers) <= FARTHEST_CAMERA).all(axis=1)]
    if not len(centers):
        centers = np.zeros((1, 3))
    mean = centers.mean(0)
    radius = (1.1 * float(np.linalg.norm(centers - mean, axis=1).max()) or 1e-3) * _RANDOM_RADIUS
    generator = np.random.default_rng(0)
    points = mean + generator.uniform(-radius, radius, (_RANDOM_POINTS, 3))
    return points, generator.integers(0, 256, (_RANDOM_POINTS, 3), np.uint8)
