"""viser's camera, which turns around a point, and views as everything else has them."""

import numpy as np
from numpy.typing import NDArray

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.viewer.viewed_scene import ViewedScene


def orbit(view: Bookmark, scene: ViewedScene) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Place of a camera, and the point on its axis nearest to what the photographs look at, around which it turns."""
    pose = np.linalg.inv(view.viewmat)
    position, forward = pose[:3, 3], pose[:3, 2]
    distance = float((scene.focus - position) @ forward)
    if distance <= 0.1 * scene.frame_spacing:
        distance = 3 * scene.frame_spacing
    return tuple(map(float, position)), tuple(map(float, position + distance * forward))


def rotation(wxyz: NDArray[np.floating]) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, shape [3, 3]."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
