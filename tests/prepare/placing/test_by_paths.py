"""Thermal images without GPS: which of them lie where the ones before and after them do."""

import cv2
import numpy as np

from thermosplat.prepare.placing.by_paths import on_the_path
from thermosplat.prepare.placing.world_edges import Pose

DOWN = np.diag([1.0, -1.0, -1.0])


def flown() -> dict[int, Pose]:
    """Two strips of eight images, 6 m apart, with the wind's turns."""
    generator = np.random.default_rng(0)
    poses = {}
    for number in range(16):
        strip, along = divmod(number, 8)
        heading = np.diag([1.0, 1.0, 1.0]) if strip == 0 else np.diag([-1.0, -1.0, 1.0])
        wind = cv2.Rodrigues(generator.normal(0, 0.01, 3))[0]
        place = np.array([6.0 * (along if strip == 0 else 7 - along), 10.0 * strip, 30.0])
        poses[number] = Pose(wind @ heading @ DOWN, place + generator.normal(0, 0.4, 3))
    return poses


def test_images_of_one_path_lie_on_it() -> None:
    """Around a turn and beside images that are missing, too."""
    poses = flown()
    assert on_the_path(poses, list(poses)) == list(poses)
    few = [number for number in poses if number not in (2, 7, 12)]
    assert on_the_path(poses, few) == few


def test_images_that_look_elsewhere_are_not_on_it() -> None:
    """One that looks another way, one the other way round, and two neighbours that are wrong together."""
    poses = flown()
    aside, around = cv2.Rodrigues(np.array([0.6, 0.0, 0.0]))[0], np.diag([-1.0, -1.0, 1.0])
    for number, turn in ((3, aside), (4, around), (11, aside), (12, aside)):
        poses[number] = Pose(turn @ poses[number].rotation, poses[number].centre)
    assert on_the_path(poses, list(poses)) == [number for number in poses if number not in (3, 4, 11, 12)]


def test_cameras_that_are_never_turned() -> None:
    """Of a slide, and of two images alone."""
    poses = {number: Pose(DOWN, np.array([float(number), 0.0, 10.0])) for number in range(6)}
    assert on_the_path(poses, list(poses)) == list(poses)
    assert on_the_path(poses, [2, 4]) == [2, 4]
