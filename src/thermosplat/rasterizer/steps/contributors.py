"""gsplat's functions of contributors: how many Gaussians a pixel shows, which, and with which weights. No gradient."""

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_shape
from thermosplat.rasterizer.checked_numbers import as_whole, checked_sizes
from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.blending.contributors import contributors_kernel
from warp_kernels.machinery.launching import launch


class Contributors(NamedTuple):
    """What pixels show, [P] or [P, room]."""

    counts: Tensor
    alphas: Tensor
    ids: Tensor
    weights: Tensor


def rasterize_num_contributing_gaussians(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    tile_offsets: Tensor,  # [..., tile_height, tile_width]
    flatten_ids: Tensor,  # [n_isects]
    image_width: int,
    image_height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor]:
    """Counts the Gaussians that each pixel shows; gsplat's function.

    Args:
        means2d: [..., N, 2], or packed [nnz, 2], px.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        tile_offsets: First pair of each tile, from ``isect_offset_encode``, [..., tile_height, tile_width].
        flatten_ids: Flat index of each pair's Gaussian, from ``isect_tiles``, [n_isects].
        image_width: [px].
        image_height: [px].
        tile_size: [px].

    Returns:
        Counts, int32 [..., H, W], and accumulated opacities, [..., H, W].

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    size = (image_width, image_height, tile_size)
    found, shape = _of_images(means2d, conics, opacities, tile_offsets, flatten_ids, size, 0)
    return found.counts.reshape(shape), found.alphas.reshape(shape)


def rasterize_contributing_gaussian_ids(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    tile_offsets: Tensor,  # [..., tile_height, tile_width]
    flatten_ids: Tensor,  # [n_isects]
    image_width: int,
    image_height: int,
    tile_size: int,
    num_contributing_gaussians: Tensor,  # [..., H, W]
) -> tuple[Tensor, Tensor]:
    """Lists the Gaussians that each pixel shows, front to back; gsplat's function.

    Args:
        means2d: As in ``rasterize_num_contributing_gaussians``, and so are the next seven.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        tile_offsets: [..., tile_height, tile_width].
        flatten_ids: [n_isects].
        image_width: [px].
        image_height: [px].
        tile_size: [px].
        num_contributing_gaussians: Counts of that function, [..., H, W].

    Returns:
        Flat indices, int32 [..., H, W, most], -1 behind the last, and weights α T, 0 there; ``most`` is the largest
        count.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    most = room_for_all(num_contributing_gaussians)
    size = (image_width, image_height, tile_size)
    found, shape = _of_images(means2d, conics, opacities, tile_offsets, flatten_ids, size, most)
    return found.ids.reshape(*shape, most), found.weights.reshape(*shape, most)


def rasterize_top_contributing_gaussian_ids(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    tile_offsets: Tensor,  # [..., tile_height, tile_width]
    flatten_ids: Tensor,  # [n_isects]
    image_width: int,
    image_height: int,
    tile_size: int,
    num_depth_samples: int,
) -> tuple[Tensor, Tensor]:
    """Lists the Gaussians of the largest weights in each pixel, front to back; gsplat's function.

    Args:
        means2d: As in ``rasterize_num_contributing_gaussians``, and so are the next seven.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        tile_offsets: [..., tile_height, tile_width].
        flatten_ids: [n_isects].
        image_width: [px].
        image_height: [px].
        tile_size: [px].
        num_depth_samples: How many, K.

    Returns:
        Flat indices, int32 [..., H, W, K], -1 where there are fewer, and weights α T, 0 there.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    most, size = room_for_top(num_depth_samples), (image_width, image_height, tile_size)
    found, shape = _of_images(means2d, conics, opacities, tile_offsets, flatten_ids, size, most)
    return found.ids.reshape(*shape, most), found.weights.reshape(*shape, most)


def room_for_all(num_contributing_gaussians: Tensor) -> int:
    """Places per pixel for all Gaussians that were counted: the largest count, 0 where there is no pixel."""
    return int(num_contributing_gaussians.max()) if num_contributing_gaussians.numel() > 0 else 0


def room_for_top(num_depth_samples: int) -> int:
    """Places per pixel for so many Gaussians.

    Raises:
        UserError: It is no whole number of at least 1.
    """
    room = as_whole(num_depth_samples)
    if type(room) is not int or room < 1:
        raise UserError(f"num_depth_samples must be at least 1, and whole, got {num_depth_samples!r}.")
    return room


def _of_images(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    size: tuple[int, int, int],
    room: int,
) -> tuple[Contributors, tuple[int, ...]]:
    """Contributors of all pixels, and the images' shape."""
    width, height = checked_sizes(image_width=size[0], image_height=size[1])
    shape = (*tile_offsets.shape[:-2], height, width)
    pixels = torch.arange(tile_offsets.shape[:-2].numel() * height * width, device=tile_offsets.device)
    return contributors_of(pixels, means2d, conics, opacities, tile_offsets, flatten_ids, size, room), shape


@torch.no_grad()
def contributors_of(
    pixels: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    size: tuple[int, int, int],
    room: int,
) -> Contributors:
    """What some pixels show.

    Args:
        pixels: Their flat indices image · H · W + y · W + x, int64 [P].
        means2d: As in ``rasterize_num_contributing_gaussians``, and so are the next four.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        tile_offsets: [..., tile_height, tile_width].
        flatten_ids: [n_isects].
        size: Width and height of the image, and of a tile [px].
        room: Contributors of a pixel that are listed.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    width, height = checked_sizes(image_width=size[0], image_height=size[1])
    if not isinstance(means2d, Tensor) or means2d.dtype not in (torch.float32, torch.float64):
        raise UserError("means2d must be a float32 or float64 tensor [..., N, 2].")
    lead = tuple(means2d.shape[:-1])
    check_shape("conics", conics, (*lead, 3), means2d, "[..., N, 3]")
    check_shape("opacities", opacities, lead, means2d, "[..., N]")
    tiles_y, tiles_x = tile_offsets.shape[-2:]
    if tiles_x * size[2] < width or tiles_y * size[2] < height:
        raise UserError(
            f"tile_offsets has {tiles_x} x {tiles_y} tiles of {size[2]} px, too few for {width} x {height} px."
        )
    kinds, count = kinds_of(means2d.dtype), len(pixels)
    found = Contributors(
        means2d.new_empty(count, dtype=torch.int32),
        means2d.new_empty(count),
        means2d.new_empty((count, room), dtype=torch.int32),
        means2d.new_empty((count, room)),
    )
    ends = torch.cat([tile_offsets.flatten().int(), flatten_ids.new_full((1,), len(flatten_ids), dtype=torch.int32)])
    read = (means2d.contiguous(), conics.contiguous(), opacities.contiguous(), flatten_ids.int().contiguous(), ends)
    types = (kinds.vec2, kinds.vec3, kinds.scalar, wp.int32, wp.int32)
    with launches_on_torch_stream(means2d.device) as device:
        arrays = [view(pixels.contiguous(), wp.int64), *map(view, read, types)]
        arrays += [view(found.counts, wp.int32), view(found.alphas, kinds.scalar)]
        arrays += [view(found.ids, wp.int32, count, room), view(found.weights, kinds.scalar, count, room)]
        inputs = [tiles_x, tiles_y, size[2], width, height, *arrays]
        launch(contributors_kernel(kinds.scalar), count, inputs, device)
    return found
