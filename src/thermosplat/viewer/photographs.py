"""The photograph that was taken nearest to a view, as it looks from there.

Every pixel of the view is a point of the scene, at the depth that the spectrum sees (``thermography.reprojection``).
From the photograph's own pose this is the photograph itself, whatever the depth.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.thermography.reprojection import camera_points, pose_distances, sampled, seen_from, warped
from thermosplat.viewer.viewed_scene import ViewedScene

_SAME_POSE = 1e-4
"""Distance of poses, in frame spacings and radians, below which depth does not matter."""


@dataclass(frozen=True, eq=False)
class SeenPhotograph:
    """A photograph as it looks from a view."""

    frame: Frame
    image: Tensor
    """Shape [H, W, C] in [0, 1]; NaN where the view shows what the photograph does not."""

    @property
    def valid(self) -> Tensor:
        """Mask [H, W] of the pixels that the photograph has."""
        return ~self.image.isnan().any(dim=-1)


class Photographs:
    """The photographs of a scene's capture, seen from elsewhere."""

    def __init__(self, scene: ViewedScene) -> None:
        self.scene = scene
        self._taken = lru_cache(maxsize=4)(self._taken_anew)  # one after the other while the camera moves

    def nearest_frame(self, spectrum: str, viewmat: NDArray[np.floating]) -> Frame:
        """The frame whose camera is nearest to a pose, by place and direction.

        Args:
            spectrum: One that the frame has a view in.
            viewmat: World to camera, shape [4, 4].

        Raises:
            ValueError: No frame has a view in it.
        """
        frames = [frame for frame in self.scene.frames if spectrum in frame.views]
        if not frames:
            raise ValueError(f"There are no {spectrum} photographs.")
        taken = np.stack([frame.views[spectrum].viewmat for frame in frames])
        return frames[int(pose_distances(taken, viewmat, self.scene.frame_spacing).argmin())]

    def nearest(self, spectrum: str, view: ViewTensors) -> SeenPhotograph:
        """The nearest photograph as it looks from a view.

        Args:
            view: Camera and pose, without distortion.

        Raises:
            ValueError: There is no photograph of that spectrum.
        """
        viewmat = view.viewmat.cpu().numpy()
        frame = self.nearest_frame(spectrum, viewmat)
        taken = self._taken(frame, spectrum)
        assert taken.image is not None  # noqa: S101  a view of a capture
        distance = pose_distances(frame.views[spectrum].viewmat[None], viewmat, self.scene.frame_spacing)[0]
        if distance <= _SAME_POSE:
            depth = torch.ones(view.height, view.width, device=view.K.device)
            positions, _ = seen_from(taken, view, camera_points(view, depth))
            return SeenPhotograph(frame, sampled(taken.image, positions))
        model = self.scene.model
        depth = model.render_depth(spectrum, view)
        return SeenPhotograph(frame, warped(model, spectrum, taken.image, taken, view, depth))

    def _taken_anew(self, frame: Frame, spectrum: str) -> ViewTensors:
        return view_tensors(frame.views[spectrum], None, self.scene.device)
