"""Images as they look from elsewhere: each pixel of a view is a point of the scene, and lies somewhere in an image.

Where that point lies in the image, and the image's own camera sees nothing in front of it, the pixel has the image's
value.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.scene.lens_distortion import distorted_positions
from thermosplat.scene.lens_slopes import bent, straightened
from thermosplat.scene.model import SceneModel

HIDDEN = 0.05
"""Share of the depth by which a point may lie behind what an image's camera saw, and still be what is in the image."""
_COARSE = 320
"""Width [px] at which an image's own depth is rendered, to tell what is hidden."""


def pose_distances(taken: NDArray[np.floating], viewmat: NDArray[np.floating], spacing: float) -> NDArray[np.floating]:
    """How far poses are from another one: places in frame spacings plus angles in radians, [V].

    Args:
        taken: The poses, world to camera, [V, 4, 4].
        viewmat: The other one, [4, 4].
        spacing: Distance between neighbouring frames.
    """
    poses, pose = np.linalg.inv(taken), np.linalg.inv(viewmat.astype(np.float64))
    places = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=-1) / max(spacing, 1e-12)
    traces = np.einsum("vij,ij->v", poses[:, :3, :3], pose[:3, :3])
    return places + np.arccos(np.clip((traces - 1) / 2, -1, 1 - 1e-12))


def resized(view: ViewTensors, width: int, height: int) -> ViewTensors:
    """The same camera at another size of its image [px]."""
    factors = torch.tensor([[width / view.width], [height / view.height], [1.0]], device=view.K.device)
    return replace(
        view, K=view.K * factors, width=width, height=height, image=None, intensity=None, values=None, mask=None
    )


def coarse_view(view: ViewTensors) -> ViewTensors:
    """The camera at a size that tells what is hidden."""
    factor = min(1.0, _COARSE / view.width)
    return resized(view, max(1, round(factor * view.width)), max(1, round(factor * view.height)))


def pixel_rays(view: ViewTensors) -> Tensor:
    """Where pixels look, in camera axes: rays to z = 1 of a perspective camera, [H, W, 3]."""
    device = view.K.device
    y, x = torch.meshgrid(
        torch.arange(view.height, device=device) + 0.5, torch.arange(view.width, device=device) + 0.5, indexing="ij"
    )
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(view.K).T
    if view.lens is not None:
        rays = torch.cat([straightened(rays[..., :2], view), rays[..., 2:]], dim=-1)
    return rays


def distances(view: ViewTensors, depth: Tensor) -> Tensor:
    """How far from the camera what a view sees is [units of the scene], [H, W]; NaN where it sees nothing.

    Args:
        view: The camera.
        depth: z-depth, [H, W]; 0 where there is nothing.
    """
    along = depth if view.orthographic else depth * pixel_rays(view).norm(dim=-1)
    return torch.where(depth > 0, along, torch.nan)


def camera_points(view: ViewTensors, depth: Tensor) -> Tensor:
    """What a view sees, in camera axes, [H, W, 3].

    Args:
        view: The camera, of perspective or of parallel rays.
        depth: z-depth, [H, W].
    """
    rays = pixel_rays(view)
    return torch.cat([rays[..., :2], depth[..., None]], dim=-1) if view.orthographic else rays * depth[..., None]


def scene_points(view: ViewTensors, depth: Tensor) -> Tensor:
    """The points of the scene that a view sees, [H, W, 3], in the scene's frame.

    Args:
        view: The camera.
        depth: z-depth, [H, W].
    """
    return (camera_points(view, depth) - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def normals_of(depth: Tensor, view: ViewTensors) -> Tensor:
    """Unit normals of what a view sees, in camera axes, [H, W, 3].

    Args:
        depth: z-depth of its pixels, [H, W].
        view: The camera.
    """
    smooth = torch.nn.functional.avg_pool2d(depth[None, None], 5, 1, 2, count_include_pad=False)[0, 0]
    points = camera_points(view, smooth)
    down, across = torch.gradient(points, dim=(0, 1))
    normal = torch.linalg.cross(across, down)
    return normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-20)


def seen_from(taken: ViewTensors, view: ViewTensors, points: Tensor) -> tuple[Tensor, Tensor]:
    """Where points of a view lie in another one.

    Args:
        taken: The other one.
        view: The view.
        points: In its camera's axes (``camera_points``), [H, W, 3].

    Returns:
        Positions [px], [H, W, 2], NaN behind the camera; depths there, [H, W].
    """
    between = taken.viewmat.double() @ torch.linalg.inv(view.viewmat.double())
    points = points @ between[:3, :3].T.float() + between[:3, 3].float()
    depths = points[..., 2]
    slopes = bent(points[..., :2] / depths.clamp(min=1e-9)[..., None], taken)
    positions = slopes * taken.K.diagonal()[:2] + taken.K[:2, 2]
    if taken.distortion is not None:
        positions = distorted_positions(positions, taken.K, taken.distortion)
    return torch.where(depths[..., None] > 1e-9, positions, torch.nan), depths


def sampled(image: Tensor, positions: Tensor, mode: str = "bilinear") -> Tensor:
    """An image [H, W, C] at positions [h, w, 2] in px; NaN outside of it.

    Args:
        image: The image.
        positions: Where.
        mode: "bilinear", or "nearest" of labels.
    """
    height, width = image.shape[:2]
    size = torch.tensor([width, height], device=image.device)
    grid = 2 * positions / size - 1
    inside = ((positions >= 0) & (positions <= size)).all(dim=-1, keepdim=True)
    found = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None],
        torch.nan_to_num(grid)[None],
        mode=mode,
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    return torch.where(inside, found, torch.nan)


def warped(
    model: SceneModel,
    spectrum: str,
    image: Tensor,
    taken: ViewTensors,
    view: ViewTensors,
    depth: Tensor,
    mode: str = "bilinear",
) -> Tensor:
    """An image as it looks from a view, [H, W, C]; NaN where the view shows what the image does not.

    Args:
        model: The scene, which says what is hidden.
        spectrum: In which spectrum.
        image: The image, [h, w, C].
        taken: Its camera.
        view: From where it is to be seen.
        depth: z-depth that the spectrum has in the view, [H, W]; 0 where it sees nothing.
        mode: As of ``sampled``.
    """
    positions, depths = seen_from(taken, view, camera_points(view, depth))
    found = sampled(image, positions, mode)
    coarse = coarse_view(taken)
    scale = torch.tensor([coarse.width / taken.width, coarse.height / taken.height], device=view.K.device)
    nearest = sampled(model.render_depth(spectrum, coarse)[..., None], positions * scale)[..., 0]
    there = (depths <= (1 + HIDDEN) * nearest) & (depth > 0)
    return torch.where(there[..., None], found, torch.nan)
