"""Median depths of a projected scene: where a pixel's surface lies, whatever shows through it.

The expected depth Σ w z / Σ w is drawn to what lies far behind a surface that is not quite opaque. Half of the weight
lies before the median, however far behind the rest is. 2D Gaussian Splatting (Huang et al. 2024, supplement) renders
the depth at which half of the light is blocked for the same reason; here the half is of what the pixel shows, so that
it is the same where a pixel is covered in part.
"""

import torch
import warp as wp
from torch import Tensor

from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.blending.median_depth import median_block, median_depth_kernel
from warp_kernels.machinery.launching import launch


def median_depths(scene: ProjectedScene) -> Tensor:
    """The depth of the Gaussian at which half of a pixel's accumulated opacity is reached, front to back.

    Args:
        scene: The scene, blended at its opacities (not at ``thermal_opacities``).

    Returns:
        z-depths, or distances where the scene is sorted by them [world units], [..., C, H, W]; 0 where no Gaussian is
        drawn. Not differentiable.
    """
    return covered_depths(scene)[0]


@torch.no_grad()
def covered_depths(scene: ProjectedScene) -> tuple[Tensor, Tensor]:
    """Median depths, and which pixels the Gaussians cover.

    Returns:
        Median depths; where the accumulated opacity is a half or more, bool. Both [..., C, H, W].
    """
    settings = scene.settings
    found = scene.depths.new_zeros((*scene.images_shape, settings.height, settings.width))
    covered = torch.zeros_like(found, dtype=torch.int32)
    if found.numel() == 0:
        return found, covered.bool()
    lists = scene.binned(scene.opacities.detach().reshape(-1, 1))
    bins, kinds = lists.bins, kinds_of(found.dtype)
    read = [scene.means2d, scene.projected.packed_roots, scene.opacities, scene.depths]
    types = [kinds.vec2, kinds.vec4, kinds.scalar, kinds.scalar]
    held = [tensor.detach().contiguous() for tensor in read]
    with launches_on_torch_stream(found.device) as device:
        arrays = [view(tensor, kind) for tensor, kind in zip(held, types, strict=True)]
        arrays += [view(lists.tensors[name], wp.int32) for name in ("gaussian_ids", "tile_offsets")]
        sizes = [bins.tiles_x, bins.tiles_y, bins.tile_size, settings.width, settings.height]
        outputs = [view(found, kinds.scalar), view(covered, wp.int32)]
        edge = median_block(device)
        across, down = -(-settings.width // edge), -(-settings.height // edge)
        blocks = found.numel() // (settings.width * settings.height) * across * down
        launch(median_depth_kernel(kinds.scalar, edge), blocks, [*sizes, *arrays, *outputs], device, chunk=1)
    return found, covered.bool()
