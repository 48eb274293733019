"""The photograph that was taken nearest to a view, as it looks from there.

Every pixel of the view is a point of the scene, at the depth that the spectrum sees. Where that point lies in the
photograph, and the photograph's own camera sees nothing in front of it, the pixel has the photograph's colour. From the
photograph's own pose this is the photograph itself, whatever the depth.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.scene.lens_distortion import distorted_positions
from thermosplat.scene.lens_slopes import bent, straightened
from thermosplat.viewer.viewed_scene import ViewedScene, resized

HIDDEN = 0.05
"""Share of the depth by which a point may lie behind what its photograph saw, and still be what was photographed."""
_SAME_POSE = 1e-4
"""Distance of poses, in frame spacings and radians, below which depth does not matter."""


@dataclass(frozen=True, eq=False)
class SeenPhotograph:
    """A photograph as it looks from a view."""

    frame: Frame
    """The frame it is of."""
    image: Tensor
    """Shape [H, W, C] in [0, 1]; NaN where the view shows what the photograph does not."""

    @property
    def valid(self) -> Tensor:
        """Mask [H, W] of the pixels that the photograph has."""
        return ~self.image.isnan().any(dim=-1)


class Photographs:
    """The photographs of a scene's capture, seen from elsewhere.

    Args:
        scene: The scene.
    """

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
        return frames[int(_distances(taken, viewmat, self.scene.frame_spacing).argmin())]

    def nearest(self, spectrum: str, view: ViewTensors) -> SeenPhotograph:
        """The nearest photograph as it looks from a view.

        Args:
            spectrum: Its spectrum.
            view: Camera and pose, without distortion.

        Raises:
            ValueError: There is no photograph of that spectrum.
        """
        viewmat = view.viewmat.cpu().numpy()
        frame = self.nearest_frame(spectrum, viewmat)
        taken = self._taken(frame, spectrum)
        assert taken.image is not None  # noqa: S101  a view of a capture
        distance = _distances(frame.views[spectrum].viewmat[None], viewmat, self.scene.frame_spacing)[0]
        depth = torch.ones(view.height, view.width, device=view.K.device)
        if distance > _SAME_POSE:
            depth = self.scene.model.render_depth(spectrum, view)
        positions, depths = _seen_from(taken, view, depth)
        image = _sampled(taken.image, positions)
        if distance > _SAME_POSE:
            coarse = resized(taken, *self._depth_size(taken))
            seen = self.scene.model.render_depth(spectrum, coarse)
            scale = torch.tensor([coarse.width / taken.width, coarse.height / taken.height], device=view.K.device)
            nearest = _sampled(seen[..., None], positions * scale)[..., 0]
            image = torch.where((depths <= (1 + HIDDEN) * nearest)[..., None], image, torch.nan)
            image = torch.where((depth > 0)[..., None], image, torch.nan)
        return SeenPhotograph(frame, image)

    def _taken_anew(self, frame: Frame, spectrum: str) -> ViewTensors:
        return view_tensors(frame.views[spectrum], None, self.scene.device)

    def _depth_size(self, taken: ViewTensors) -> tuple[int, int]:
        """Size [px] at which a photograph's own depth is rendered: at most 320 wide, to tell what is hidden."""
        factor = min(1.0, 320 / taken.width)
        return max(1, round(factor * taken.width)), max(1, round(factor * taken.height))


def _distances(taken: NDArray[np.floating], viewmat: NDArray[np.floating], spacing: float) -> NDArray[np.floating]:
    """How far poses [V, 4, 4] are from another one: places in frame spacings plus angles in radians."""
    poses, pose = np.linalg.inv(taken), np.linalg.inv(viewmat.astype(np.float64))
    places = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=-1) / max(spacing, 1e-12)
    traces = np.einsum("vij,ij->v", poses[:, :3, :3], pose[:3, :3])
    return places + np.arccos(np.clip((traces - 1) / 2, -1, 1 - 1e-12))


def _seen_from(taken: ViewTensors, view: ViewTensors, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Where the points of a view at depths [H, W] lie in another one [px], [H, W, 2], and their depths there."""
    device = view.K.device
    y, x = torch.meshgrid(
        torch.arange(view.height, device=device) + 0.5, torch.arange(view.width, device=device) + 0.5, indexing="ij"
    )
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(view.K).T
    if view.lens is not None:
        rays = torch.cat([straightened(rays[..., :2], view), rays[..., 2:]], dim=-1)
    between = taken.viewmat.double() @ torch.linalg.inv(view.viewmat.double())
    points = (rays * depth[..., None]) @ between[:3, :3].T.float() + between[:3, 3].float()
    depths = points[..., 2]
    slopes = bent(points[..., :2] / depths.clamp(min=1e-9)[..., None], taken)
    positions = slopes * taken.K.diagonal()[:2] + taken.K[:2, 2]
    if taken.distortion is not None:
        positions = distorted_positions(positions, taken.K, taken.distortion)
    return torch.where(depths[..., None] > 1e-9, positions, torch.nan), depths


def _sampled(image: Tensor, positions: Tensor) -> Tensor:
    """An image [H, W, C] at positions [h, w, 2] in px, bilinear; NaN outside of it."""
    height, width = image.shape[:2]
    size = torch.tensor([width, height], device=image.device)
    grid = 2 * positions / size - 1
    inside = ((positions >= 0) & (positions <= size)).all(dim=-1, keepdim=True)
    sampled = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None],
        torch.nan_to_num(grid)[None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    return torch.where(inside, sampled, torch.nan)
