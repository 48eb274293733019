"""gsplat's functions of the contributors of chosen pixels: how many Gaussians they show, which, with which weights.

Pixels are described as in ``sparse_pixels``. No gradient.
"""

from typing import NamedTuple

from torch import Tensor

from thermosplat.rasterizer.steps.contributors import Contributors, contributors_of, room_for_all, room_for_top
from thermosplat.rasterizer.steps.sparse_pixels import flat_pixels, offsets_of_all_tiles


class _Lists(NamedTuple):
    """Chosen tiles, what they list, and their chosen pixels; as the functions' arguments."""

    active_tiles: Tensor
    tile_offsets: Tensor
    flatten_ids: Tensor
    tile_pixel_mask: Tensor
    pixel_map: Tensor


class _Size(NamedTuple):
    """Of an image and of its tiles [px], and its tiles across and down."""

    width: int
    height: int
    tile_size: int
    tile_width: int
    tile_height: int


def rasterize_num_contributing_gaussians_sparse(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    active_tiles: Tensor,  # [AT]
    tile_offsets: Tensor,  # [AT + 1]
    flatten_ids: Tensor,  # [n_isects]
    tile_pixel_mask: Tensor,  # [AT, words]
    tile_pixel_cumsum: Tensor,  # [AT]
    pixel_map: Tensor,  # [P]
    image_width: int,
    image_height: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
) -> tuple[Tensor, Tensor]:
    """Counts the Gaussians that chosen pixels show; gsplat's function.

    Args:
        means2d: [..., N, 2], or packed [nnz, 2], px.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        active_tiles: From ``build_sparse_tile_layout``, and so are the next ones of its names, [AT].
        tile_offsets: From ``isect_tiles_sparse``, [AT + 1].
        flatten_ids: Likewise, [n_isects].
        tile_pixel_mask: [AT, words].
        tile_pixel_cumsum: [AT].
        pixel_map: [P].
        image_width: [px].
        image_height: [px].
        tile_size: [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.

    Returns:
        Counts, int32 [P], and accumulated opacities, [P], in the order of the pixels.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    lists = _Lists(active_tiles, tile_offsets, flatten_ids, tile_pixel_mask, pixel_map)
    size = _Size(image_width, image_height, tile_size, tile_width, tile_height)
    found = _contributors(means2d, conics, opacities, lists, size, 0)
    return found.counts, found.alphas


def rasterize_contributing_gaussian_ids_sparse(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    active_tiles: Tensor,  # [AT]
    tile_offsets: Tensor,  # [AT + 1]
    flatten_ids: Tensor,  # [n_isects]
    tile_pixel_mask: Tensor,  # [AT, words]
    tile_pixel_cumsum: Tensor,  # [AT]
    pixel_map: Tensor,  # [P]
    num_contributing_gaussians: Tensor,  # [P]
    image_width: int,
    image_height: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
) -> tuple[Tensor, Tensor]:
    """Lists the Gaussians that chosen pixels show, front to back; gsplat's function.

    Args:
        means2d: As in ``rasterize_num_contributing_gaussians_sparse``, and so are the next eight.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        active_tiles: [AT].
        tile_offsets: [AT + 1].
        flatten_ids: [n_isects].
        tile_pixel_mask: [AT, words].
        tile_pixel_cumsum: [AT].
        pixel_map: [P].
        num_contributing_gaussians: Counts of that function, [P].
        image_width: [px].
        image_height: [px].
        tile_size: [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.

    Returns:
        Flat indices, int32 [P, most], -1 behind the last, and weights α T, 0 there; ``most`` is the largest count.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    lists = _Lists(active_tiles, tile_offsets, flatten_ids, tile_pixel_mask, pixel_map)
    size = _Size(image_width, image_height, tile_size, tile_width, tile_height)
    found = _contributors(means2d, conics, opacities, lists, size, room_for_all(num_contributing_gaussians))
    return found.ids, found.weights


def rasterize_top_contributing_gaussian_ids_sparse(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    opacities: Tensor,  # [..., N] or [nnz]
    active_tiles: Tensor,  # [AT]
    tile_offsets: Tensor,  # [AT + 1]
    flatten_ids: Tensor,  # [n_isects]
    tile_pixel_mask: Tensor,  # [AT, words]
    tile_pixel_cumsum: Tensor,  # [AT]
    pixel_map: Tensor,  # [P]
    image_width: int,
    image_height: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    num_depth_samples: int,
) -> tuple[Tensor, Tensor]:
    """Lists the Gaussians of the largest weights in chosen pixels, front to back; gsplat's function.

    Args:
        means2d: As in ``rasterize_num_contributing_gaussians_sparse``, and so are the next eight.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        opacities: [..., N] or [nnz].
        active_tiles: [AT].
        tile_offsets: [AT + 1].
        flatten_ids: [n_isects].
        tile_pixel_mask: [AT, words].
        tile_pixel_cumsum: [AT].
        pixel_map: [P].
        image_width: [px].
        image_height: [px].
        tile_size: [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.
        num_depth_samples: How many, K.

    Returns:
        Flat indices, int32 [P, K], -1 where there are fewer, and weights α T, 0 there.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    lists = _Lists(active_tiles, tile_offsets, flatten_ids, tile_pixel_mask, pixel_map)
    size = _Size(image_width, image_height, tile_size, tile_width, tile_height)
    found = _contributors(means2d, conics, opacities, lists, size, room_for_top(num_depth_samples))
    return found.ids, found.weights


def _contributors(
    means2d: Tensor, conics: Tensor, opacities: Tensor, lists: _Lists, size: _Size, room: int
) -> Contributors:
    """What the pixels show, ``room`` Gaussians of each."""
    per_image = size.tile_width * size.tile_height
    active = lists.active_tiles
    images = int(active.max()) // per_image + 1 if len(active) > 0 else 1
    tiles = (images, size.tile_height, size.tile_width)
    shown = (size.width, size.height)
    chosen = flat_pixels(active, lists.tile_pixel_mask, lists.pixel_map, tiles, size.tile_size, shown)
    offsets = offsets_of_all_tiles(active, lists.tile_offsets, tiles)
    return contributors_of(
        chosen, means2d, conics, opacities, offsets, lists.flatten_ids, (*shown, size.tile_size), room
    )
