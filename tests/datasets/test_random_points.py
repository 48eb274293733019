"""Points to start from where a capture has none."""

import numpy as np
import pytest

from thermosplat.datasets.random_points import MIN_POINTS, random_points, starting_places


def test_the_points_fill_a_cube_around_the_cameras() -> None:
    """Its middle is the cameras', its half side 3.3 times the farthest camera's distance from there."""
    centers = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1.0, 4.0]])
    points, colors = random_points(centers)
    middle = centers.mean(0)
    half = 3.0 * 1.1 * np.linalg.norm(centers - middle, axis=1).max()
    distances = np.abs(points - middle)
    assert distances.max() <= half * (1 + 1e-6)
    np.testing.assert_allclose(distances.mean(0), half / 2, rtol=0.02)
    assert (colors.min(), colors.max()) == (0, 255)


def test_the_points_are_the_same_every_time() -> None:
    """A resumed or repeated run starts from them again."""
    first, second = random_points(np.ones((3, 3))), random_points(np.ones((3, 3)))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_impossible_cameras_do_not_move_the_points() -> None:
    """A pose that is refused later does not count."""
    centers = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    far = np.vstack([centers, [[1e30, 0.0, 0.0]]])
    np.testing.assert_array_equal(random_points(centers)[0], random_points(far)[0])


@pytest.mark.parametrize(
    ("places", "repeated", "found"), [(1, 5, 1), (3, 1, 3), (MIN_POINTS, 2, MIN_POINTS), (9, 1, MIN_POINTS), (0, 0, 0)]
)
def test_places_are_counted_and_not_points(places: int, repeated: int, found: int) -> None:
    """Up to as many as are needed; points that are not finite do not count."""
    points = np.arange(3 * places, dtype=np.float32).reshape(places, 3).repeat(repeated, axis=0)
    points = np.vstack([points, np.full((2, 3), np.nan, np.float32)])
    assert starting_places(points) == found
