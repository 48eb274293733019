"""How far apart sparse points lie: the first size of the Gaussians that start from them."""

import cv2
import numpy as np
from numpy.typing import NDArray

NUM_NEIGHBORS = 3
"""Neighbours that set a Gaussian's first size. 3DGS."""

SMALLEST_SQUARED_DISTANCE = 1e-7
"""Floor of the mean squared distance [world units²], so that duplicate points have a finite log-scale. 3DGS."""

_FLANN_KDTREE_SINGLE = 4  # one k-d tree over all dimensions: exact, unlike FLANN's randomised forest


def neighbor_distances(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Root mean square distance of every point to its 3 nearest neighbours.

    The root of the mean *squared* distance is what 3DGS's reference code and gsplat's trainer use. The search is exact.

    Args:
        points: Positions [world units], shape [M, 3], M >= 4, finite.

    Returns:
        Distances [world units], shape [M], at least sqrt(1e-7), 3DGS's floor for duplicate points.

    Raises:
        ValueError: If there are fewer than 4 points.
    """
    if len(points) <= NUM_NEIGHBORS:
        raise ValueError(f"neighbor_distances needs at least {NUM_NEIGHBORS + 1} points, got {len(points)}.")
    # Centred first: squared distances lose digits when the points lie far from the origin.
    centred = np.ascontiguousarray(points - points.mean(axis=0, dtype=np.float64), dtype=np.float32)
    index = cv2.flann.Index(centred, {"algorithm": _FLANN_KDTREE_SINGLE})
    # A point finds itself, too; "checks" -1 lets the search visit every leaf it has to.
    _, squared = index.knnSearch(centred, NUM_NEIGHBORS + 1, params={"checks": -1, "eps": 0.0, "sorted": True})
    mean_squared = np.sort(squared, axis=1)[:, 1:].mean(axis=1)
    return np.sqrt(np.maximum(mean_squared, SMALLEST_SQUARED_DISTANCE)).astype(np.float32)
