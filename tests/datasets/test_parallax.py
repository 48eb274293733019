"""How well depths of a capture can be known is told from its cameras and points."""

import numpy as np
import pytest

from thermosplat.datasets.parallax import Seen, parallax_remark, triangulation_angle

K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])


def camera(x: float, turned: float = 0.0) -> Seen:
    """A camera at (x, 0, 0) that looks along z, turned about y [°]."""
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [x, 0.0, 0.0]
    return Seen(viewmat, K, 100, 100)


def test_largest_angle_between_cameras_that_see_a_place() -> None:
    """A place 10 away, seen from 2 apart; a third camera that looks elsewhere does not count."""
    places = np.array([[1.0, 0.0, 10.0]])
    cameras = [camera(0.0), camera(2.0), camera(9.0, turned=120.0)]
    assert triangulation_angle(cameras, places) == pytest.approx(2 * np.degrees(np.arctan(0.1)))


def test_nothing_is_said_where_nothing_is_known() -> None:
    """No camera, one, no points, or points behind all cameras."""
    for cameras, places in (
        ([], np.ones((3, 3))),
        ([camera(0.0)], np.ones((3, 3))),
        ([camera(0.0), camera(1.0)], np.empty((0, 3))),
        ([camera(0.0), camera(1.0)], np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0]])),
    ):
        assert triangulation_angle(cameras, places) is None
    assert parallax_remark(None) is None


def test_turning_on_the_spot_is_named() -> None:
    """Cameras that hardly move have a remark, those that walk have none."""
    places = np.random.default_rng(0).uniform([-3, -3, 8], [3, 3, 12], (500, 3))
    on_the_spot = [camera(0.05 * i, turned=5.0 * i) for i in range(-3, 4)]
    walking = [camera(0.7 * i) for i in range(-3, 4)]
    remark = parallax_remark(triangulation_angle(on_the_spot, places))
    assert remark is not None
    assert "do not turn on the spot" in remark
    assert parallax_remark(triangulation_angle(walking, places)) is None
