"""Which photographs share a camera, and what is known of it before any of them is matched.

Photographs of one maker, model, size and focal length are of one camera. Its focal length comes from the calibration,
else from EXIF, else it is a guess that mapping improves: 1.2 times the longer side, as COLMAP guesses.
"""

import math
from collections import defaultdict
from collections.abc import Sequence

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import pycolmap

from thermosplat.datasets.lens import Lens
from thermosplat.prepare.capture_folder import FrameRow

CAMERA_MODEL = "SIMPLE_RADIAL"
"""One focal length and one radial term while photographs are added: with more, the first few bend the lens."""
_GUESS = 1.2
_FILM_DIAGONAL = math.hypot(36, 24)


def cameras_of(
    photographs: Sequence[FrameRow], calibrated: Lens | None
) -> list[tuple[pycolmap.Camera, list[FrameRow]]]:
    """The cameras, each with its photographs.

    Args:
        calibrated: Lens that a board showed; it holds for all photographs of its size.

    Returns:
        Cameras without an id, in the order of their first photographs.
    """
    groups: dict[tuple[object, ...], list[FrameRow]] = defaultdict(list)
    for row in photographs:
        groups[row.make, row.model, row.width, row.height, row.focal_length_mm, row.focal_length_35mm].append(row)
    return [(_camera(rows[0], calibrated), rows) for rows in groups.values()]


def guessed_anew(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The camera with a guess instead of the focal length that EXIF states: it may be of an image that was cropped."""
    params = [_GUESS * max(camera.width, camera.height), camera.width / 2, camera.height / 2, 0.0]
    guess = pycolmap.Camera(model=CAMERA_MODEL, params=params, width=camera.width, height=camera.height)
    guess.camera_id = camera.camera_id
    return guess


def _camera(row: FrameRow, calibrated: Lens | None) -> pycolmap.Camera:
    if calibrated is not None and (calibrated.width, calibrated.height) == (row.width, row.height):
        camera = calibrated.colmap_camera()
        camera.has_prior_focal_length = True
        return camera
    focal_length = _GUESS * max(row.width, row.height)
    if row.focal_length_35mm:
        focal_length = row.focal_length_35mm / _FILM_DIAGONAL * math.hypot(row.width, row.height)
    params = [focal_length, row.width / 2, row.height / 2, 0.0]
    camera = pycolmap.Camera(model=CAMERA_MODEL, params=params, width=row.width, height=row.height)
    camera.has_prior_focal_length = bool(row.focal_length_35mm)
    return camera
