"""Mirrored and turned sensors."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermosplat.datasets.lens import Lens
from thermosplat.prepare.checking.plane_warp import PlaneWarp
from thermosplat.prepare.checking.sensor_orientation import Orientation, find_orientation, orientation_as_registered


def pair(number: int) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """A photograph, and a thermal image of its middle with other brightness of the same objects."""
    rng = np.random.default_rng(number)
    photograph = np.full((240, 320, 3), 60, np.uint8)
    heat = np.full((240, 320), 20.0)
    for _ in range(14):
        corner, size = rng.integers(0, (300, 220)), rng.integers(20, 90, 2)
        far = corner + size
        cv2.rectangle(photograph, corner.tolist(), far.tolist(), rng.integers(0, 255, 3).tolist(), -1)
        cv2.rectangle(heat, corner.tolist(), far.tolist(), float(rng.uniform(10, 40)), -1)
    middle = cv2.GaussianBlur(heat, (0, 0), 2)[24:216, 32:288]
    return photograph, (100 * cv2.resize(middle, (160, 120))).astype(np.uint16)


PAIRS = [pair(number) for number in range(12)]


@pytest.mark.rotating
@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
@pytest.mark.parametrize("mirror", [False, True])
def test_orientations(quarter: int, mirror: bool) -> None:
    """What is said turns the thermal images upright again."""
    turned = []
    for photograph, thermal in PAIRS:
        mirrored = thermal[:, ::-1] if mirror else thermal
        turned.append(
            (photograph, np.ascontiguousarray(np.rot90(mirrored, quarter)))
        )  # undone by --turn, then --mirror
    found = find_orientation(turned)
    assert found == Orientation(90 * quarter, mirror)
    assert found.upright == (quarter == 0 and not mirror)


@pytest.mark.rotating
@pytest.mark.parametrize("quarter", [0, 1, 2])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("camera", [0, 2])
def test_images_beside_their_registered_camera(quarter: int, mirror: bool, camera: int) -> None:
    """What is said makes them what the camera sees, which may be built in upside down itself."""
    turned = []
    for photograph, thermal in PAIRS:
        seen = np.rot90(thermal, camera)
        turned.append((photograph, np.ascontiguousarray(np.rot90(seen[:, ::-1] if mirror else seen, quarter))))
    pose = np.diag([1 - camera, 1 - camera, 1.0, 1.0])
    lenses = Lens("PINHOLE", (260.0, 260.0, 160.0, 120.0), 320, 240), Lens("PINHOLE", (162.5, 162.5, 80, 60), 160, 120)
    warps = [PlaneWarp(*lenses, pose, 2.0)] * len(turned)
    assert orientation_as_registered(turned, warps) == Orientation(90 * quarter, mirror)
    assert orientation_as_registered([(photograph, PAIRS[0][1]) for photograph, _ in turned], warps) is None
    assert orientation_as_registered(turned[:4], warps[:4]) is None


def test_nothing_stands_out() -> None:
    """Images that do not belong together, and too few pairs, say nothing."""
    wrong = [(photograph, pair(100 + number)[1]) for number, (photograph, _) in enumerate(PAIRS)]
    assert find_orientation(wrong) is None
    assert find_orientation(PAIRS[:4]) is None


def test_orientations_are_named_by_flags_of_the_import() -> None:
    """As the import takes them."""
    assert Orientation(90, True).flags == "--turn 90 --mirror"
    assert Orientation(180, False).flags == "--turn 180"
