"""What a trained scene shows in a view, pixel by pixel: depth, colours, and the measured values of all spectra."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.datasets.placement import Placement
from thermosplat.export.scene import shown_colors
from thermosplat.scene.model import SceneModel
from thermosplat.scene.rendered_frame import LEAST_COVER
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.scene_temperatures import SceneTemperatures

RECALCULATED = "recalculated"
"""In names of values: 1 where temperatures were recalculated."""
LARGEST_STEP = 0.05
"""Depths that differ from a neighbour's by more than this share lie on an edge, where a pixel shows two surfaces."""


@dataclass(frozen=True)
class DepthView:
    """One view. All spectra are rendered by its camera, whichever camera took them."""

    view: ViewTensors
    depth: Tensor
    """z-depth in the scene's frame, [H, W]; 0 where there is none."""
    colors: Tensor
    """Colours of the spectrum in [0, 1], [H, W, 3]: a photograph's, or through its palette."""
    values: dict[str, Tensor]
    """Measured values by ``scalar_<spectrum>_<unit>``, [H, W]; where temperatures are recalculated, 1 in
    ``scalar_<spectrum>_recalculated`` says which."""


@torch.no_grad()
def depth_view(
    model: SceneModel,
    name: str,
    view: ViewTensors,
    scales: Mapping[str, PixelScale],
    *,
    sh_degree: int,
    temperatures: SceneTemperatures | None = None,
) -> DepthView:
    """Render a view.

    Args:
        name: The spectrum whose depth and colours are taken.
        view: Its camera; a distortion of the lens is left out.
        temperatures: How temperatures are recalculated; None: they are not.
    """
    pinhole = view.as_pinhole()
    rendered = model.render(dict.fromkeys(model.spectra, pinhole), sh_degree=sh_degree)
    depth = model.render_depth(name, pinhole)
    depth = torch.where(rendered.alphas[name][..., 0] >= LEAST_COVER, depth, 0.0)
    depth = torch.where(_edges(depth), 0.0, depth)
    values = {}
    for spectrum, image in rendered.images.items():
        unit = scales[spectrum].measured_unit
        if unit is not None:
            made = (temperatures or SceneTemperatures(model, scales)).of_image(spectrum, image, pinhole)
            values[f"scalar_{spectrum}_{unit}"] = made.values
            if made.changed is not None:
                changed = torch.as_tensor(made.changed, device=made.values.device)
                values[f"scalar_{spectrum}_{RECALCULATED}"] = changed.float()
    return DepthView(pinhole, depth, shown_colors(rendered.images[name].clamp(0, 1), scales[name]), values)


def _edges(depth: Tensor) -> Tensor:
    """Pixels beside a jump of the depth, [H, W]."""
    edges = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (0, 1):
        first, second = depth.narrow(axis, 0, depth.shape[axis] - 1), depth.narrow(axis, 1, depth.shape[axis] - 1)
        jumps = (first - second).abs() > LARGEST_STEP * torch.maximum(first, second)
        edges.narrow(axis, 0, depth.shape[axis] - 1).logical_or_(jumps)
        edges.narrow(axis, 1, depth.shape[axis] - 1).logical_or_(jumps)
    return edges


@dataclass(frozen=True)
class PointCloud:
    """Points with colours and values, on the host."""

    points: NDArray[np.floating]
    """[M, 3], in the frame of the capture's poses: float64 where they lie far from its origin, else float32."""
    colors: NDArray[np.uint8]
    """8-bit RGB, [M, 3]."""
    values: dict[str, NDArray[np.float32]]
    """By name, [M] each."""


def depth_points(
    model: SceneModel,
    name: str,
    views: Sequence[ViewTensors],
    scales: Mapping[str, PixelScale],
    *,
    sh_degree: int,
    most: int = 1_000_000,
    temperatures: SceneTemperatures | None = None,
) -> PointCloud:
    """The surface that a spectrum sees, as points: pixels of the views at their depths.

    Args:
        views: Cameras, those of training.
        most: Points at most; each view gives its share, at random.
    """
    generator = torch.Generator().manual_seed(0)
    parts: list[tuple[NDArray[np.float32], NDArray[np.uint8], dict[str, NDArray[np.float32]]]] = []
    for view in views:
        seen = depth_view(model, name, view, scales, sh_degree=sh_degree, temperatures=temperatures)
        rows, columns = (index.cpu() for index in torch.nonzero(seen.depth > 0, as_tuple=True))
        chosen = torch.randperm(len(rows), generator=generator)[: most // len(views)]
        rows, columns = rows[chosen].to(seen.depth.device), columns[chosen].to(seen.depth.device)
        depth = seen.depth[rows, columns]
        x = (columns + 0.5 - seen.view.K[0, 2]) / seen.view.K[0, 0] * depth
        y = (rows + 0.5 - seen.view.K[1, 2]) / seen.view.K[1, 1] * depth
        in_camera = torch.stack([x, y, depth], dim=-1)
        points = (in_camera - seen.view.viewmat[:3, 3]) @ seen.view.viewmat[:3, :3]
        colors = (seen.colors[rows, columns] * 255.0).round().byte()
        values = {key: image[rows, columns].cpu().numpy().astype(np.float32) for key, image in seen.values.items()}
        parts.append((points.cpu().numpy(), colors.cpu().numpy(), values))
    if not parts:
        return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), {})
    merged = {key: np.concatenate([values[key] for _, _, values in parts]) for key in parts[0][2]}
    placed = placed_points(np.concatenate([part[0] for part in parts]), model.placement)
    return PointCloud(placed, np.concatenate([part[1] for part in parts]), merged)


def placed_points(points: NDArray[np.floating], placement: Placement) -> NDArray[np.floating]:
    """Points of a scene [M, 3] in the world, with as many digits as they have there.

    Args:
        points: In the scene's frame.
    """
    return placement.to_world(points).astype(np.float64 if placement.is_moved else np.float32)
