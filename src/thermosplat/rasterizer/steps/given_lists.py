"""A projection and tile lists that the caller made, as the kernels of the blending take them."""

import math
import threading
from typing import Any

import torch
import warp as wp
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_shape, checked_choice
from thermosplat.rasterizer.blending_autograd import TileLists
from thermosplat.rasterizer.checked_numbers import checked_sizes
from thermosplat.rasterizer.graph_breaks import refuse_transforms
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.rasterizer.projection_autograd import ProjectedTensors
from thermosplat.torch_bridge.arrays import view
from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.constants import ALPHA_MIN, EXTENT_MIN
from warp_kernels.projection.projection import ProjectionSettings

NO_REMAINDER = 2.0
"""What ``packed_roots.pack`` makes of a remainder of zero in float32."""

_KINDS = {torch.int32: wp.int32, torch.int64: wp.int64, torch.uint8: wp.uint8}


class GivenScene(ProjectedScene):
    """Gaussians in images, with the lists of tiles that somebody made of them; blended as any ``ProjectedScene``.

    Args:
        means2d: [..., N, 2], or [nnz, 2] packed, px.
        conics: [..., N, 3] or [nnz, 3], 1/px². What is not positive definite is not drawn.
        opacities: [..., N] or [nnz].
        width: Of the image [px].
        height: Of the image [px].
        tile_size: 8, 16 or 32 [px].
        isect_offsets: int32 [..., tile_height, tile_width].
        flatten_ids: int32 [pairs].
        masks: Tiles to draw, bool [..., tile_height, tile_width]; None: all.

    Raises:
        UserError: an argument has the wrong shape or type.
    """

    def __init__(
        self,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        width: int,
        height: int,
        tile_size: int,
        isect_offsets: Tensor,
        flatten_ids: Tensor,
        masks: Tensor | None = None,
    ) -> None:
        refuse_transforms()
        width, height = checked_sizes(image_width=width, image_height=height)
        tile_size = checked_choice("tile_size", tile_size)
        if not isinstance(means2d, Tensor) or means2d.dtype not in (torch.float32, torch.float64):
            raise UserError("means2d must be a float32 or float64 tensor [..., N, 2].")
        lead = tuple(means2d.shape[:-1])
        check_shape("means2d", means2d, (*lead, 2), means2d, "[..., N, 2]")
        check_shape("conics", conics, (*lead, 3), means2d, "[..., N, 3]")
        check_shape("opacities", opacities, lead, means2d, "[..., N]")
        tiles_y, tiles_x = isect_offsets.shape[-2:]
        if tiles_x * tile_size < width or tiles_y * tile_size < height:
            raise UserError(
                f"isect_offsets has {tiles_x} x {tiles_y} tiles of {tile_size} px, too few for {width} x {height} px."
            )
        if masks is not None:
            if masks.shape != isect_offsets.shape:
                raise UserError(f"masks must have shape {list(isect_offsets.shape)}, got {list(masks.shape)}.")
            isect_offsets, flatten_ids = of_drawn_tiles(isect_offsets, flatten_ids, masks)
        images_shape = tuple(isect_offsets.shape[:-2])
        images, rows = math.prod(images_shape), math.prod(lead)
        a, b, c = conics.unbind(-1)
        sound = (a > 0) & (a * c > b * b)
        a, b, c = (torch.where(sound, one, other) for one, other in ((a, 1.0), (b, 0.0), (c, 1.0)))
        slope = b / a
        roots = torch.stack([a.sqrt(), slope, (c - b * slope).sqrt()], -1)
        means2d, drawn_opacities = means2d.contiguous(), torch.where(sound, opacities, 0.0).contiguous()
        with torch.no_grad():
            remainder = NO_REMAINDER if means2d.dtype == torch.float32 else 0.0
            packed_roots = torch.cat([roots, torch.full_like(roots[..., :1], remainder)], -1).contiguous()
            extent = (2.0 * (drawn_opacities / ALPHA_MIN).clamp(min=1.0).log()).sqrt().clamp(min=EXTENT_MIN)
            deviations = torch.stack([c, a], -1) / (a * roots[..., 2] ** 2)[..., None]
            extents = (extent[..., None] * deviations.sqrt()).contiguous()
            drawn = torch.ones(*lead, 2, dtype=torch.int32, device=means2d.device)
        projected = ProjectedTensors(means2d, opacities, roots, None, drawn, extents, packed_roots)
        super().__init__(
            projected,
            projected.arrays(),
            drawn_opacities,
            None,
            [],
            ProjectionSettings(width, height, max(1, rows // max(images, 1)), 1, images),
            images_shape,
            tile_size,
            threading.Lock(),
            lists=_tile_lists(isect_offsets, flatten_ids, rows, tile_size),
        )


def of_drawn_tiles(isect_offsets: Tensor, flatten_ids: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
    """Lists in which tiles that are not drawn are empty.

    Args:
        isect_offsets: int32 [..., tile_height, tile_width].
        flatten_ids: int32 [pairs].
        masks: Tiles to draw, bool [..., tile_height, tile_width].
    """
    counts = _counts(isect_offsets, flatten_ids)
    kept = torch.repeat_interleave(masks.flatten() != 0, counts)
    counts = counts * (masks.flatten() != 0)
    return (counts.cumsum(0) - counts).int().view(isect_offsets.shape), flatten_ids[kept]


def _counts(isect_offsets: Tensor, flatten_ids: Tensor) -> Tensor:
    """Pairs of each tile, int64 [tiles]."""
    ends = isect_offsets.new_full((1,), len(flatten_ids))
    return torch.cat([isect_offsets.flatten(), ends]).long().diff()


def _tile_lists(isect_offsets: Tensor, flatten_ids: Tensor, rows: int, tile_size: int) -> TileLists:
    """The lists with what the adjoint reads beside them."""
    pairs, device = len(flatten_ids), flatten_ids.device
    ids = flatten_ids.int().contiguous()
    counts = torch.bincount(ids.long(), minlength=rows)
    tensors: dict[str, Tensor] = {
        "gaussian_ids": ids,
        "tile_offsets": torch.cat([isect_offsets.flatten().int(), ids.new_full((1,), pairs)]),
        "tiles_per_gaussian": counts.int(),
        "masks": torch.full((pairs if ids.is_cuda else 0,), 255, dtype=torch.uint8, device=device),
    }
    if not ids.is_cuda:  # where the adjoint writes one record for each pair, and adds them up by Gaussian
        slots = torch.empty_like(ids)
        slots[torch.argsort(ids, stable=True)] = torch.arange(pairs, dtype=torch.int32)
        tensors |= {"slots": slots, "order": torch.arange(rows, dtype=torch.int32), "pair_ends": counts.cumsum(0)}
    arrays: dict[str, Any] = {name: view(tensor, _KINDS[tensor.dtype]) for name, tensor in tensors.items()}
    tiles_y, tiles_x = isect_offsets.shape[-2:]
    bins = TileBins(
        **dict.fromkeys(("slots", "order", "pair_ends"), None) | arrays,
        totals=None,
        num_pairs=pairs,
        expected_pairs=pairs,
        has_room=False,
        tile_size=tile_size,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
    )
    return TileLists(bins, tensors)
