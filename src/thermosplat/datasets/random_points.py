"""Starting points of captures whose poses are known without a point cloud."""

import numpy as np
from numpy.typing import NDArray

MIN_POINTS = 4
"""A Gaussian's first scale comes from the three nearest neighbours of its point."""
_RANDOM_POINTS = 50_000
"""As many as nerfstudio's splatfacto starts with."""
_RANDOM_RADIUS = 3.0
"""Half the side of the box of random points, in camera-to-centre distances (gsplat's trainer: init_extent 3)."""
STARTING_RANDOM = f"starting from {_RANDOM_POINTS:,} random points around the cameras."
"""The end of the note that says so."""


def random_points(centers: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Uniform points [M, 3] of random colours [M, 3] uint8 in a cube around the cameras, the same ones every time.

    Args:
        centers: [N, 3] positions of the cameras [world units].
    """
    mean = centers.mean(0)
    radius = max(1.1 * float(np.linalg.norm(centers - mean, axis=1).max()), 1e-3) * _RANDOM_RADIUS
    generator = np.random.default_rng(0)
    points = mean + generator.uniform(-radius, radius, (_RANDOM_POINTS, 3))
    return points.astype(np.float32), generator.integers(0, 256, (_RANDOM_POINTS, 3), np.uint8)
