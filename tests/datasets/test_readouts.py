"""Readouts: motions between lines, and the lines that are left of an image that is shrunk or undistorted."""

from typing import get_args

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera, camera_center
from thermosplat.datasets.lens import Lens, rectification, rectified_camera
from thermosplat.datasets.readouts import LineOrder, Readout, motion_of, paces

AXIS = np.array([0.2, -0.5, 0.3]) / np.linalg.norm([0.2, -0.5, 0.3])
DRIFT = np.array([0.03, -0.01, 0.02])
CAMERA = Camera(40.0, 40.0, 24.0, 16.0, 48, 32)


def pose_at(time: float, degrees: float = 4.0) -> NDArray[np.float64]:
    """An even motion, [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.radians(degrees) * time * AXIS)[0], time * DRIFT
    return pose


def readout(order: LineOrder = "top-to-bottom") -> Readout:
    return Readout(order, np.stack([pose_at(-0.5), pose_at(0.5)]))


@pytest.mark.parametrize(("first", "last"), [(0.0, 1.0), (0.25, 0.5), (-0.1, 1.2)])
def test_poses_between_the_lines_are_those_of_an_even_motion(first: float, last: float) -> None:
    """Within the readout and beyond it."""
    found = readout().between(first, last).motion
    np.testing.assert_allclose(found, np.stack([pose_at(first - 0.5), pose_at(last - 0.5)]), atol=1e-12)


@pytest.mark.parametrize("order", get_args(LineOrder))
@pytest.mark.parametrize("factor", [2, 4])
def test_a_shrunk_image_has_the_times_of_the_lines_that_it_averages(order: LineOrder, factor: int) -> None:
    """Its first line is the mean of the first lines of the image, and so is its last."""
    smaller = CAMERA.resized(48 // factor, 32 // factor)
    lines = 32 if order in ("top-to-bottom", "bottom-to-top") else 48
    times = np.linspace(-0.5, 0.5, lines)
    expected = np.stack([pose_at(times[:factor].mean()), pose_at(times[-factor:].mean())])
    np.testing.assert_allclose(readout(order).resized(CAMERA, smaller).motion, expected, atol=1e-12)
    assert readout(order).resized(CAMERA, CAMERA).motion.tolist() == readout(order).motion.tolist()


@pytest.mark.parametrize("order", get_args(LineOrder))
@pytest.mark.parametrize(("k1", "gain"), [(-0.24, 0.9), (0.24, 3.0)])
def test_an_undistorted_image_has_nearly_the_times_of_its_pixels(order: LineOrder, k1: float, gain: float) -> None:
    """The camera turns by 4 degrees. In the mean the pose of a pixel is off by 0.7% of that, at most by 4%.

    The times of pixels are looked up in the maps that undistort the image. Where undistorting cuts lines off, as behind
    a pincushion lens, to take the first and the last line that are left for those of the file is far worse. Behind a
    barrel lens nearly all lines are left, and what is off is that they become curves.
    """
    lens = Lens("OPENCV", (280.0, 280.0, 158.0, 122.0, k1, 0.07, 0.0, 0.0), 320, 240)
    camera = rectified_camera(lens, 320, 240)
    maps = rectification(lens, 320, 240).maps
    assert maps is not None
    across = order in ("left-to-right", "right-to-left")
    times = (maps[..., 0] / 319 if across else maps[..., 1] / 239).astype(np.float64)
    shares = np.linspace(0, 1, camera.width if across else camera.height)
    if order in ("bottom-to-top", "right-to-left"):
        times, shares = 1 - times, 1 - shares
    shares = np.broadcast_to(shares if across else shares[:, None], times.shape)

    def wrong(found: Readout) -> NDArray[np.float64]:
        """By how much poses of pixels are off, as a share of the whole turn; all turn about one axis."""
        begin, end = (float(cv2.Rodrigues(pose[:3, :3])[0][:, 0] @ AXIS) for pose in found.motion)
        return np.abs((begin + shares * (end - begin)) / np.radians(4.0) - (times - 0.5))

    found = wrong(readout(order).undistorted(lens, (320, 240), camera))
    assert found.max() < 0.04
    assert found.mean() < 0.007
    assert wrong(readout(order)).mean() > gain * found.mean()


@pytest.mark.parametrize("order", get_args(LineOrder))
def test_an_image_that_loses_nothing_keeps_its_times(order: LineOrder) -> None:
    """Where there is no distortion, undistorting changes nothing."""
    lens = Lens("OPENCV", (40.0, 40.0, 24.0, 16.0, 0.0, 0.0, 0.0, 0.0), 48, 32)
    found = readout(order).undistorted(lens, (48, 32), CAMERA)
    np.testing.assert_allclose(found.motion, readout(order).motion, atol=1e-9)


def test_a_motion_moves_the_camera_as_it_says() -> None:
    """The centre moves in the world, the axes turn in the camera's; the pose is that of the middle."""
    viewmat = pose_at(3.0) @ np.linalg.inv(pose_at(-2.0, 30.0))
    turn = np.radians(2.0) * AXIS
    first, last = motion_of(viewmat, turn, DRIFT) @ viewmat
    np.testing.assert_allclose(camera_center(last) - camera_center(first), DRIFT, atol=1e-12)
    np.testing.assert_allclose(camera_center(last) + camera_center(first), 2 * camera_center(viewmat), atol=1e-12)
    np.testing.assert_allclose(cv2.Rodrigues(last[:3, :3] @ first[:3, :3].T)[0][:, 0], turn, atol=1e-9)


def test_paces_of_a_camera_that_accelerates() -> None:
    """Times need not be even; an even acceleration is found exactly. Two images say an even motion."""
    times = np.array([0.0, 0.1, 0.3, 0.35, 0.6])
    viewmats = []
    for time in times:
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues((0.5 * time + 0.8 * time**2) * AXIS)[0]
        pose[:3, 3] = -pose[:3, :3] @ (np.array([1.0, 2.0, 3.0]) + time * DRIFT + 4 * time**2 * AXIS)
        viewmats.append(pose)
    turns, moves = paces(np.stack(viewmats), times)
    expected = 0.5 + 1.6 * times
    np.testing.assert_allclose(turns, expected[:, None] * AXIS, atol=1e-9)
    np.testing.assert_allclose(moves, DRIFT + 8 * times[:, None] * AXIS, atol=1e-9)
    turns, moves = paces(np.stack(viewmats[:2]), times[:2])
    np.testing.assert_allclose(turns, [(0.5 + 1.6 * 0.05) * AXIS] * 2, atol=1e-9)
    np.testing.assert_allclose(moves, [DRIFT + 0.4 * AXIS] * 2, atol=1e-9)
