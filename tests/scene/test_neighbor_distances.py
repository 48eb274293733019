"""The first size of the Gaussians: distances to the nearest sparse points."""

import numpy as np
import pytest

from thermosplat.scene.neighbor_distances import neighbor_distances


def brute_force(points: np.ndarray) -> np.ndarray:
    squared = np.square(points[:, None].astype(np.float64) - points[None].astype(np.float64)).sum(-1)
    squared.sort(axis=1)
    return np.sqrt(np.maximum(squared[:, 1:4].mean(1), 1e-7))


def test_equals_brute_force_with_outliers_and_clusters() -> None:
    """The tree search is exact, also where the density varies by orders of magnitude."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(700, 3)).astype(np.float32)
    points[:20] *= 80
    points[20:220] *= 0.01
    np.testing.assert_allclose(neighbor_distances(points), brute_force(points), rtol=2e-4)


def test_duplicates_keep_a_finite_log_scale() -> None:
    """Four points in one place are as small as 3DGS's floor allows, not infinitely small."""
    points = np.ones((4, 3), np.float32)
    np.testing.assert_allclose(neighbor_distances(points), np.full(4, np.sqrt(1e-7)), rtol=1e-6)


def test_partial_duplicates_are_exact() -> None:
    """A point with one twin counts it as a neighbour at distance 0 (itself it does not count)."""
    points = np.array([[0, 0, 0], [0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], np.float32)
    np.testing.assert_allclose(neighbor_distances(points)[0], np.sqrt((0 + 4 + 4) / 3), rtol=1e-6)


def test_far_from_the_origin() -> None:
    """Coordinates of a map projection do not drown the small distances."""
    points = np.random.default_rng(1).integers(0, 64, (100, 3)).astype(np.float32) / 8 + np.float32(4096)
    np.testing.assert_allclose(neighbor_distances(points), brute_force(points), rtol=1e-4)


def test_too_few_points() -> None:
    """Three points have no three neighbours each."""
    with pytest.raises(ValueError, match="at least 4 points, got 3"):
        neighbor_distances(np.zeros((3, 3), np.float32))
