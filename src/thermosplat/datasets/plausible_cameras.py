"""Cameras and poses that no photograph was taken with: errors, and notes where a capture may be meant so."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thermosplat.datasets.cameras import FARTHEST_CAMERA, camera_center
from thermosplat.datasets.frame_files import FrameFiles, Shot
from thermosplat.datasets.images.image_folders import shown_path
from thermosplat.datasets.lens import CUT_PANORAMAS
from thermosplat.errors import UserError

LONGEST_SIDE = 65_536
"""Most pixels of an image's side: JPEG has 65,535."""
_FOCAL_SIDES = (1e-3, 1e4)
"""Focal lengths and principal points in longer sides of the image: the longest telescopes on a camera have some 100."""
_MOST_DISTORTION = 1e6
"""Largest coefficient of a lens: measured ones lie below 100."""
_OUTLYING = 1e3
"""Times the median distance of the cameras from their middle beyond which a camera is told of. Open choice."""
_FAR = 20.0
"""The same times the distance that four fifths of the cameras keep: the room that was taken on the spot has 6.0, seven
other good captures 1.0 to 1.5. Open choice."""


def check_camera(shot: Shot, root: Path) -> None:
    """Refuse an image whose camera has no possible focal length, size or place: no render looks like it.

    Args:
        shot: The image.
        root: The capture's folder.

    Raises:
        UserError: Names the image and what its camera is said to be.
    """
    lens, name = shot.lens, shown_path(shot.path, root)
    if not lens.focal_lengths():
        raise UserError(f"The camera of {name} is {lens.model}: images of 360 degrees are not read.", CUT_PANORAMAS)
    side = max(lens.width, lens.height)
    possible = min(lens.width, lens.height) > 0 and side <= LONGEST_SIDE and bool(np.isfinite(lens.params).all())
    if possible:
        focal, params = lens.focal_lengths(), np.abs(lens.params)
        low, high = (share * side for share in _FOCAL_SIDES)
        possible = low <= min(focal) and max(focal) <= high and params.max() <= max(high, _MOST_DISTORTION)
    if not possible:
        numbers = ", ".join(f"{value:g}" for value in lens.params)
        raise UserError(
            f"The camera of {name} is impossible: {lens.model} of {lens.width:.6g}x{lens.height:.6g} px with the "
            f"parameters {numbers}.",
            "Focal lengths are positive and in pixels. Calibrate it anew (colmap), or correct the file that states it.",
        )
    if not np.isfinite(shot.viewmat).all():
        raise UserError(f"The pose of {name} is not finite.", "Register the images anew (colmap mapper).")
    if not np.abs(camera_center(shot.viewmat)).max() <= FARTHEST_CAMERA:
        raise UserError(
            f"The camera of {name} lies {np.abs(camera_center(shot.viewmat)).max():.3g} world units from the origin.",
            "Correct the file that states its pose, or register the images anew (colmap mapper).",
        )


def outlying_notes(frames: Sequence[FrameFiles], root: Path) -> list[str]:
    """A note (none or one) on cameras that lie far from where the others are.

    Args:
        frames: All frames.
        root: The capture's folder.
    """
    shots = [frame.shots[frame.leading] for frame in frames]
    centers = np.array([camera_center(shot.viewmat) for shot in shots])
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    usual = float(np.median(distances))
    beyond = min(_OUTLYING * usual, _FAR * float(np.quantile(distances, 0.8)))
    outlying = np.flatnonzero(distances > beyond) if usual > 0 else np.empty(0, int)
    if not len(outlying):
        return []
    first = outlying[0]
    return [
        f"The cameras of {len(outlying)} of {len(shots)} frames lie far from the others (first: "
        f"{shown_path(shots[first].path, root)}, {distances[first] / usual:,.0f} times as far from the middle as half "
        "of them). Are the poses right?"
    ]
