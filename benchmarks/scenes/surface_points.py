"""Where the surface lies that each pixel of a view shows, by its depth."""

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View

Array = NDArray[np.float64]


def surface_points(view: View, depth: Array) -> Array:
    """The surface behind each pixel [world units], [H, W, 3].

    Args:
        view: The view, without lens distortion.
        depth: z-depths [world units], [H, W].
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.camera.K).T
    pose = np.linalg.inv(view.viewmat)
    return (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
