"""viser's camera, which turns around a point, and views as everything else has them."""

import numpy as np

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
