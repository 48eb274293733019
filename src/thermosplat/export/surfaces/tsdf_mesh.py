"""A mesh of what a spectrum sees: rendered depths fused into a truncated signed distance, its zero as triangles.

Each voxel keeps the mean over the views of how far it lies in front of the rendered surface, along the viewing axis and
cut off at a few voxels (Curless and Levoy 1996). Voxels far behind a surface are not seen. Marching cubes are
scikit-image's (extra "mesh"). Vertices take the mean colour and value of the views that see them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.export.surfaces.depth_views import DepthView, PointCloud, depth_view, placed_points
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.scene_temperatures import SceneTemperatures

TRUNCATION = 4.0
"""Voxels at which distances are cut off."""
MOST_VOXELS = 1 << 28
_LEAST_VIEWS = 2
"""A voxel that fewer views see is no part of a surface."""
_CHUNK = 1 << 21
"""Voxels that are projected at once."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with colours and values at their vertices."""

    vertices: PointCloud
    """Positions, colours and values."""
    faces: NDArray[np.int32]
    """Indices of vertices, [F, 3], counter-clockwise seen from outside."""


def tsdf_mesh(
    model: SceneModel,
    name: str,
    views: Sequence[ViewTensors],
    scales: Mapping[str, PixelScale],
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    voxel: float,
    sh_degree: int,
    temperatures: SceneTemperatures | None = None,
) -> Mesh:
    """The mesh of a spectrum.

    Args:
        bounds: Lowest and highest coordinates [world units] of what is meshed, [3] each.
        voxel: Side of a voxel [world units], > 0.
        temperatures: How temperatures are recalculated; None: they are not.

    Raises:
        UserError: scikit-image is missing, there are too many voxels, or no surface lies in the bounds.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise UserError(
            "Meshes are made with scikit-image, which is not installed.",
            'Install it: pip install ".[mesh]" in the repository.',
        ) from error
    if not (np.isfinite(voxel) and voxel > 0):
        raise UserError(f"--voxel must be greater than 0, found {voxel:g}.")
    low, high = map(model.placement.to_scene, bounds)
    voxel /= model.placement.unit
    with np.errstate(over="ignore"):
        counts = np.ceil((high - low) / voxel) + 1
    if not np.prod(counts) <= MOST_VOXELS:
        raise UserError(
            f"{' x '.join(f'{count:,.0f}' for count in counts)} voxels are too many (more than {MOST_VOXELS:,}).",
            "Give a larger --voxel.",
        )
    shape = tuple(int(count) for count in counts)
    how: dict[str, Any] = {"sh_degree": sh_degree, "temperatures": temperatures}
    seen = [depth_view(model, name, view, scales, **how) for view in views]
    distance, weight = _fused(seen, low, shape, voxel)
    try:
        known = _known_cells(weight >= _LEAST_VIEWS)
        corners, faces, _, _ = marching_cubes(distance, level=0.0, mask=known, allow_degenerate=False)
    except (ValueError, RuntimeError) as error:
        raise UserError(
            f"No surface of {name} was found within the scene.", "Is the run trained? Give another --voxel."
        ) from error
    vertices = _colored(seen, (low + corners * voxel).astype(np.float32), TRUNCATION * voxel)
    placed = placed_points(vertices.points, model.placement)
    return Mesh(replace(vertices, points=placed), faces.astype(np.int32))


def _fused(
    seen: Sequence[DepthView], low: NDArray[np.float64], shape: tuple[int, ...], voxel: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean signed distance in voxels, positive in front of the surface, and the number of views, both of ``shape``."""
    device = seen[0].depth.device if seen else torch.device("cpu")
    count = int(np.prod(shape))
    total, weight = torch.zeros(count, device=device), torch.zeros(count, device=device)
    origin = torch.as_tensor(low, dtype=torch.float32, device=device)
    for start in range(0, count, _CHUNK):
        index = torch.arange(start, min(start + _CHUNK, count), device=device)
        cells = torch.stack([index // (shape[1] * shape[2]), index // shape[2] % shape[1], index % shape[2]], dim=-1)
        points = origin + voxel * cells
        for one in seen:
            depth, ahead, _ = _looked_up(one, points)
            distance = (depth - ahead) / voxel
            known = (depth > 0) & (distance > -TRUNCATION)
            total[index] += torch.where(known, distance.clamp(max=TRUNCATION), 0.0)
            weight[index] += known.float()
    mean = torch.where(weight > 0, total / weight.clamp(min=1.0), TRUNCATION)
    return mean.reshape(shape).cpu().numpy(), weight.reshape(shape).cpu().numpy()


def _known_cells(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells whose eight corners are all known, marked at their last corner, where scikit-image looks."""
    cells = np.zeros_like(known)
    cells[1:, 1:, 1:] = np.logical_and.reduce(
        [
            known[x : known.shape[0] - 1 + x, y : known.shape[1] - 1 + y, z : known.shape[2] - 1 + z]
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
    )
    return cells


def _looked_up(one: DepthView, points: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Depth of the pixel that each point falls into (0: none), the point's own depth, and the pixel's row, column."""
    in_camera = points @ one.view.viewmat[:3, :3].T + one.view.viewmat[:3, 3]
    ahead = in_camera[:, 2]
    z = ahead.clamp(min=1e-6)
    column = (in_camera[:, 0] / z * one.view.K[0, 0] + one.view.K[0, 2]).floor()
    row = (in_camera[:, 1] / z * one.view.K[1, 1] + one.view.K[1, 2]).floor()
    inside = (ahead > 1e-6) & (column >= 0) & (column < one.view.width) & (row >= 0) & (row < one.view.height)
    pixel = torch.where(inside, row, 0.0).long(), torch.where(inside, column, 0.0).long()
    return torch.where(inside, one.depth[pixel], 0.0), ahead, pixel


def _colored(seen: Sequence[DepthView], vertices: NDArray[np.float32], reach: float) -> PointCloud:
    """Vertices with the mean colours and values of the views in which they lie on the surface."""
    device = seen[0].depth.device
    points = torch.as_tensor(vertices, device=device)
    names = list(seen[0].values)
    total, weight = torch.zeros(len(points), 3 + len(names), device=device), torch.zeros(len(points), 1, device=device)
    for one in seen:
        depth, ahead, pixel = _looked_up(one, points)
        on_surface = ((depth > 0) & ((depth - ahead).abs() < reach)).float()[:, None]
        found = torch.cat([one.colors[pixel], *(one.values[name][pixel][:, None] for name in names)], dim=-1)
        total += on_surface * found
        weight += on_surface
    mean = (total / weight.clamp(min=1.0)).cpu().numpy().astype(np.float32)
    unseen = weight[:, 0].cpu().numpy() == 0
    values = {name: np.where(unseen, np.nan, mean[:, 3 + i]).astype(np.float32) for i, name in enumerate(names)}
    return PointCloud(vertices, np.rint(mean[:, :3].clip(0, 1) * 255).astype(np.uint8), values)
