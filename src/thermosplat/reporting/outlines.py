"""Outlines of things in the photograph: where colours change along the border of a warm region.

Heat under a surface spreads without regard to what is painted on it, and what is warmer than the same material beside
it has another reason than its material. A thing of another material is warm or cold by itself, by the sun or by its
emissivity. So the colours on both sides of a region's border are compared, as the scene's photographs show them there.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.viewer.viewed_scene import ViewedScene

_WINDOW = 9
"""Of the colours on a side [px]: textures are smaller."""
_CONTRAST = 0.06
"""Difference of colours in [0, 1] from which on they are of two things."""
_SHARE = 0.5
"""Of the border, from which on it is an outline."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """What the photographs show in a view."""

    photograph: NDArray[np.float32]
    """Colours in [0, 1], [H, W, 3]."""

    def contrast(self, pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Difference of the colours inside and outside along the border of a region, [border pixels].

        Args:
            pixels: The region, [H, W].
        """
        inside = pixels.astype(np.float32)
        border = cv2.dilate(inside, np.ones((3, 3))) - cv2.erode(inside, np.ones((3, 3))) > 0
        within, without = (self._mean(weight) for weight in (inside, 1 - cv2.dilate(inside, np.ones((3, 3)))))
        apart: NDArray[np.float32] = np.abs(within - without).mean(axis=-1)[border]
        return apart[np.isfinite(apart)]

    def show(self, pixels: NDArray[np.bool_]) -> bool:
        """Whether most of a region's border is an outline of the photograph.

        Args:
            pixels: The region, [H, W].
        """
        apart = self.contrast(pixels)
        return bool(len(apart)) and float((apart > _CONTRAST).mean()) > _SHARE

    def _mean(self, weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean colour of some pixels around each, NaN where there are none."""
        size = (_WINDOW, _WINDOW)
        total = cv2.blur(weight, size)[..., None]
        colors = cv2.blur(self.photograph * weight[..., None], size)
        return np.where(total > 1e-3, colors / np.maximum(total, 1e-3), np.nan).astype(np.float32)


@torch.no_grad()
def photographed(scene: ViewedScene, view: ViewTensors) -> Outlines | None:
    """What a scene's photographs show in a view of another spectrum; None without any.

    Args:
        scene: The scene.
        view: From where.
    """
    names = [name for name, scale in scene.scales.items() if scale.kind == "photograph"]
    if not names:
        return None
    image = scene.model.render({names[0]: view}, sh_degree=scene.sh_degree, shared_cameras=[[names[0]]]).images[
        names[0]
    ]
    return Outlines(image.clamp(0, 1).cpu().numpy())
