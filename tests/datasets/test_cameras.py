"""Pinhole cameras: intrinsics, resizing, position."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from thermosplat.datasets.cameras import Camera, camera_center


def test_intrinsic_matrix():
    """K holds focal lengths and principal point where OpenCV expects them."""
    K = Camera(10.0, 20.0, 3.0, 4.0, 6, 8).K
    np.testing.assert_array_equal(K, [[10, 0, 3], [0, 20, 4], [0, 0, 1]])


@given(width=st.integers(1, 500), height=st.integers(1, 500), u=st.floats(0, 1), v=st.floats(0, 1))
def test_resizing_keeps_the_rays(width: int, height: int, u: float, v: float):
    """The ray through a relative image position does not change with the image's size."""
    camera = Camera(50.0, 70.0, 33.0, 21.0, 64, 48)
    resized = camera.resized(width, height)
    assert (resized.width, resized.height) == (width, height)

    def ray(camera: Camera) -> np.ndarray:
        return np.linalg.solve(camera.K, [u * camera.width, v * camera.height, 1])

    np.testing.assert_allclose(ray(resized), ray(camera), atol=1e-9)


def test_camera_center_is_where_the_camera_maps_to_its_origin():
    """The centre in camera coordinates is zero."""
    angle = 0.7
    viewmat = np.eye(4)
    viewmat[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    viewmat[:3, 3] = (1.0, -2.0, 3.0)
    center = camera_center(viewmat)
    np.testing.assert_allclose(viewmat @ [*center, 1], [0, 0, 0, 1], atol=1e-12)
