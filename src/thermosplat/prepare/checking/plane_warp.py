"""A thermal image as its photograph's camera sees it, over a plane at the depth of the sparse points.

This is for looking at: objects before or behind that plane are shifted by their parallax.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.colmap.model import RegisteredImage, read_model
from thermosplat.datasets.lens import Lens


@dataclass(frozen=True, eq=False)
class PlaneWarp:
    """A registered pair.

    Args:
        thermal_from_photograph: [4, 4] from one camera's coordinates to the other's.
        depth: Of the plane before the photograph's camera [world units].
    """

    photograph: Lens
    thermal: Lens
    thermal_from_photograph: NDArray[np.float64]
    depth: float

    def thermal_on_photograph(self, image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
        """The thermal image [h, w, 3] resampled to the photograph's view at another size; black where it sees nothing.

        Args:
            image: The thermal image at its camera's size or another one.
            width: Of the result [px].
            height: The same.
        """
        camera, other = self.photograph.colmap_camera(), self.thermal.colmap_camera()
        x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        pixels = np.stack([x.ravel() * camera.width, y.ravel() * camera.height], -1)
        rays = np.nan_to_num(np.asarray(camera.cam_from_img(pixels), np.float64))
        points = np.concatenate([rays, np.ones((len(rays), 1))], 1) * self.depth
        moved = points @ self.thermal_from_photograph[:3, :3].T + self.thermal_from_photograph[:3, 3]
        before = moved[:, 2] > 1e-6
        moved[~before] = (0, 0, 1)
        seen = np.nan_to_num(np.asarray(other.img_from_cam(moved), np.float64), nan=-1e6)
        seen[~before] = -1e6
        scale = np.array([image.shape[1] / other.width, image.shape[0] / other.height])
        place = (seen * scale - 0.5).astype(np.float32).reshape(height, width, 2)
        return cv2.remap(image, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def read_warps(sparse: Path, pairs: Sequence[tuple[str, str]]) -> Mapping[tuple[str, str], PlaneWarp]:
    """Warps of the pairs that are registered, by the pair.

    Args:
        pairs: Names as the model has them: rgb/0001.jpg, thermal/0001.png.
    """
    model = read_model(sparse)
    images: dict[str, RegisteredImage] = {str(image.name): image for image in model.images}
    warps = {}
    for first, second in pairs:
        if first in images and second in images:
            one, two = images[first], images[second]
            depth = _median_depth(one, model.points)
            warps[first, second] = PlaneWarp(one.lens, two.lens, two.viewmat @ np.linalg.inv(one.viewmat), depth)
    return warps


def _median_depth(image: RegisteredImage, points: NDArray[np.float64]) -> float:
    """Median depth of the points that lie in the image [world units]; 1 if there are none."""
    inside = points @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
    inside = inside[inside[:, 2] > 0]
    if not len(inside):
        return 1.0
    camera = image.lens.colmap_camera()
    pixels = np.nan_to_num(np.asarray(camera.img_from_cam(inside.astype(np.float64))), nan=-1)
    visible = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)
    return float(np.median(inside[visible if visible.any() else slice(None), 2]))
