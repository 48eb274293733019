"""gsplat's functions of chosen pixels: their tiles, what those list, and the pixels' colours.

What Gaussians the pixels show is in ``sparse_contributors``.

A layout describes pixels by their tiles: ``active_tiles``, flat indices of the tiles that hold a pixel; a mask of bits
for each; how many pixels lie in the tiles up to each; and the order of pixels by tile. Tiles without a chosen pixel
list nothing, so that only chosen tiles are blended.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.steps.pixels import rasterize_to_pixels
from thermosplat.rasterizer.steps.tiles import isect_offset_encode, isect_tiles

WORD = 64
"""Pixels of a mask's word."""


class SparseTileLayout(NamedTuple):
    """What ``build_sparse_tile_layout`` returns."""

    active_tiles: Tensor
    """int32 [AT], ascending."""
    active_tile_mask: Tensor
    """bool [n_images, tile_height, tile_width]."""
    tile_pixel_mask: Tensor
    """uint64 [AT, words], a bit per pixel of the tile, row by row from the lowest bit."""
    tile_pixel_cumsum: Tensor
    """int64 [AT], pixels of the tiles up to this one, itself included."""
    pixel_map: Tensor
    """int64 [P], the pixels in the order of tiles, and of rows in a tile."""


def build_sparse_tile_layout(
    pixels: Tensor,  # [P, 2]
    image_ids: Tensor,  # [P]
    n_images: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
) -> SparseTileLayout:
    """Sorts chosen pixels into tiles; gsplat's function.

    Args:
        pixels: (row, column) of each, whole numbers, [P, 2]; none twice.
        image_ids: Its image, [P].
        n_images: Number of images.
        tile_size: Edge of a tile [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.

    Raises:
        UserError: the pixels have the wrong shape, lie outside of the tiles, or one is there twice.
    """
    if pixels.dim() != 2 or pixels.shape[1] != 2 or image_ids.shape != pixels.shape[:1]:
        raise UserError(
            f"pixels must have shape [P, 2] and image_ids [P], got {list(pixels.shape)} and {list(image_ids.shape)}."
        )
    row, column, image = pixels[:, 0].long(), pixels[:, 1].long(), image_ids.long()
    inside = (row >= 0) & (row < tile_height * tile_size) & (column >= 0) & (column < tile_width * tile_size)
    if not bool((inside & (image >= 0) & (image < n_images)).all()):
        raise UserError("pixels must lie in the tiles of images 0 to n_images - 1, found one outside.")
    tiles = (image * tile_height + row // tile_size) * tile_width + column // tile_size
    within = row % tile_size * tile_size + column % tile_size
    pixel_map = torch.argsort(tiles * tile_size**2 + within, stable=True)
    places = (tiles * tile_size**2 + within)[pixel_map]
    if bool((places[1:] == places[:-1]).any()):
        raise UserError("pixels must not hold a pixel twice, found one that is.")
    active, counts = torch.unique_consecutive(tiles[pixel_map], return_counts=True)
    mask = torch.zeros(n_images * tile_height * tile_width, dtype=torch.bool, device=pixels.device)
    mask[active] = True
    num_words = -(-(tile_size**2) // WORD)
    bits = torch.zeros(len(active), num_words * WORD, dtype=torch.bool, device=pixels.device)
    bits[torch.repeat_interleave(counts), within[pixel_map]] = True
    powers = torch.ones(WORD, dtype=torch.int64, device=pixels.device) << torch.arange(WORD, device=pixels.device)
    words = (bits.view(len(active), num_words, WORD) * powers).sum(-1).view(torch.uint64)
    cumsum = counts.cumsum(0) if len(active) > 0 else counts.new_zeros(1)
    return SparseTileLayout(active.int(), mask.view(n_images, tile_height, tile_width), words, cumsum, pixel_map)


@torch.no_grad()
def isect_tiles_sparse(
    means2d: Tensor,  # [I, N, 2] or [nnz, 2]
    radii: Tensor,  # [I, N, 2] or [nnz, 2]
    depths: Tensor,  # [I, N] or [nnz]
    tile_mask: Tensor,  # [I, tile_height, tile_width]
    active_tiles: Tensor,  # [AT]
    n_images: int,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    image_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Lists the Gaussians of chosen tiles; gsplat's function.

    Args:
        means2d: [I, N, 2], or packed [nnz, 2], px.
        radii: [I, N, 2] or [nnz, 2], px.
        depths: [I, N] or [nnz].
        tile_mask: The chosen tiles, bool [I, tile_height, tile_width].
        active_tiles: Their flat indices, ascending, [AT].
        n_images: I.
        tile_size: Edge of a tile [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.
        image_ids: Image of each packed Gaussian, [nnz].

    Returns:
        First pair of each chosen tile, and the number of pairs, int32 [AT + 1]; flat index of each pair's Gaussian,
        int32 [pairs].

    Raises:
        UserError: packed Gaussians come without their images.
    """
    packed = means2d.dim() == 2
    how = {"packed": True, "n_images": n_images, "image_ids": image_ids} if packed else {}
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, **how)  # type: ignore[arg-type]
    offsets = isect_offset_encode(isect_ids, n_images, tile_width, tile_height).flatten().long()
    counts = torch.cat([offsets, offsets.new_full((1,), len(flatten_ids))]).diff()
    kept = torch.repeat_interleave(tile_mask.flatten(), counts)
    ends = counts[active_tiles.long()].cumsum(0)
    return torch.cat([ends.new_zeros(1), ends]).int(), flatten_ids[kept]


def rasterize_to_pixels_sparse(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    colors: Tensor,  # [..., N, channels] or [nnz, channels]
    opacities: Tensor,  # [..., N] or [nnz]
    image_ids: Tensor,  # [P]
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
    backgrounds: Tensor | None = None,  # [n_images, channels]
    masks: Tensor | None = None,  # [n_images, tile_height, tile_width]
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Colours of chosen pixels; gsplat's function, with the gradients of ``rasterize_to_pixels``.

    Whole images are made, of which tiles without a chosen pixel list nothing.

    Args:
        means2d: As in ``rasterize_to_pixels``, and so are the next three.
        conics: [..., N, 3] or [nnz, 3], 1/px².
        colors: [..., N, channels] or [nnz, channels].
        opacities: [..., N] or [nnz].
        image_ids: Image of each pixel, [P], as ``build_sparse_tile_layout`` was given.
        active_tiles: From that function, and so are the four whose names it uses.
        tile_offsets: From ``isect_tiles_sparse``, [AT + 1].
        flatten_ids: Likewise, [n_isects].
        tile_pixel_mask: [AT, words].
        tile_pixel_cumsum: [AT].
        pixel_map: [P].
        image_width: [px].
        image_height: [px].
        tile_size: 8, 16 or 32 [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.
        backgrounds: [n_images, channels].
        masks: Tiles to draw, bool [n_images, tile_height, tile_width].
        packed: The Gaussians are packed.
        absgrad: As in ``rasterize_to_pixels``.

    Returns:
        ``(colors, alphas)``, [P, channels] and [P, 1], in the order of the pixels.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    images = _images(means2d, image_ids, masks, backgrounds)
    tiles = (images, tile_height, tile_width)
    if means2d.dim() not in (2, 3):
        raise UserError(f"means2d must have shape [I, N, 2] or [nnz, 2], got {list(means2d.shape)}.")
    offsets = offsets_of_all_tiles(active_tiles, tile_offsets, tiles)
    image, alphas = rasterize_to_pixels(
        means2d, conics, colors, opacities, image_width, image_height, tile_size, offsets, flatten_ids,
        backgrounds, masks, packed or means2d.dim() == 2, absgrad,
    )  # fmt: skip
    chosen = flat_pixels(active_tiles, tile_pixel_mask, pixel_map, tiles, tile_size, (image_width, image_height))
    return image.reshape(-1, image.shape[-1])[chosen], alphas.reshape(-1, 1)[chosen]


def _images(means2d: Tensor, image_ids: Tensor, *per_image: Tensor | None) -> int:
    """Number of images: what anything that has one entry per image says."""
    if means2d.dim() == 3:
        return means2d.shape[0]
    for tensor in per_image:
        if tensor is not None:
            return tensor.shape[0]
    return int(image_ids.max()) + 1 if len(image_ids) > 0 else 1


def offsets_of_all_tiles(active_tiles: Tensor, tile_offsets: Tensor, tiles: tuple[int, int, int]) -> Tensor:
    """First pair of each tile, where tiles that are not active list nothing.

    Args:
        active_tiles: As of ``build_sparse_tile_layout``, [AT].
        tile_offsets: As of ``isect_tiles_sparse``, [AT + 1].
        tiles: Images, rows and columns of tiles.

    Returns:
        int32 [images, rows, columns].
    """
    counts = torch.zeros(tiles[0] * tiles[1] * tiles[2], dtype=torch.int64, device=tile_offsets.device)
    counts[active_tiles.long()] = tile_offsets.long().diff()
    return (counts.cumsum(0) - counts).int().view(tiles)


def flat_pixels(
    active_tiles: Tensor,
    tile_pixel_mask: Tensor,
    pixel_map: Tensor,
    tiles: tuple[int, int, int],
    tile_size: int,
    size: tuple[int, int],
) -> Tensor:
    """Flat indices of the pixels of a layout.

    Args:
        active_tiles: As of ``build_sparse_tile_layout``, and so are the next two, [AT].
        tile_pixel_mask: [AT, words].
        pixel_map: [P].
        tiles: Images, rows and columns of tiles.
        tile_size: Edge of a tile [px].
        size: Width and height of an image [px].

    Returns:
        image · H · W + y · W + x of each pixel, in the order that the caller gave them in, int64 [P].
    """
    words = tile_pixel_mask.view(torch.int64)
    bits = (words[..., None] >> torch.arange(WORD, device=words.device)) & 1
    number, within = bits.flatten(1).nonzero().unbind(-1)
    tile = active_tiles.long()[number]
    _, rows, columns = tiles
    width, height = size
    y = tile // columns % rows * tile_size + within // tile_size
    x = tile % columns * tile_size + within % tile_size
    flat = tile // (rows * columns) * (width * height) + y * width + x
    return torch.empty_like(flat).index_copy_(0, pixel_map, flat)
