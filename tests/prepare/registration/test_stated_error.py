"""Stated errors cover what the data cannot see: a focal length of photographs of a wall."""

import math

import cv2
import numpy as np
import pycolmap
import pytest

from thermosplat.prepare.registration.stated_error import photographs_deviation

FOCAL_LENGTH = 400.0


def seen_points(relief: float, seed: int = 0) -> pycolmap.Reconstruction:
    """Fourteen photographs of points on a wall 3 m away with so much relief [m], adjusted from features of 0.5 px."""
    generator = np.random.default_rng(seed)
    points = np.column_stack([generator.uniform(-2, 2, (300, 2)), 3 + generator.uniform(-relief, relief, 300)])
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=400, height=300, params=[FOCAL_LENGTH, 200.0, 150.0, 0.0], camera_id=1
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for number in range(1, 15):
        turn = cv2.Rodrigues(generator.normal(0, 0.05, 3))[0]
        place = np.array([0.1 * number - 0.75, generator.uniform(-0.3, 0.3), generator.uniform(-0.1, 0.1)])
        pose = pycolmap.Rigid3d(np.column_stack([turn, -turn @ place]))
        pixels = camera.img_from_cam((points - place) @ turn.T) + generator.normal(0, 0.5, (len(points), 2))
        inside = np.flatnonzero(((pixels > 0) & (pixels < (400, 300))).all(1))
        image = pycolmap.Image(name=f"rgb/{number}.jpg", keypoints=pixels[inside], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
        for place_in_image, point in enumerate(inside):
            tracks[point].append((number, place_in_image))
    for point, track in zip(points, tracks):
        if len(track) > 1:
            elements = [pycolmap.TrackElement(*element) for element in track]
            model.add_point3D(point, pycolmap.Track(elements), np.zeros(3, np.uint8))
    pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    return model


@pytest.mark.parametrize("relief", [0.02, 0.1, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_focal_length_of_a_wall_is_not_known(relief: float, seed: int) -> None:
    """The true one lies within two standard deviations, which are small only where there is depth."""
    model = seen_points(relief, seed)
    deviation = photographs_deviation(model)
    found = model.cameras[1].mean_focal_length()
    assert abs(math.log(found / FOCAL_LENGTH)) < 2 * deviation
    assert (deviation < 0.02) == (relief == 1.0)


def test_without_points_nothing_is_known() -> None:
    """Infinite, and no failure of the adjustment."""
    assert photographs_deviation(pycolmap.Reconstruction()) == math.inf
