"""gsplat's ``isect_tiles`` and ``isect_offset_encode``: which Gaussians which tiles show. No gradient.

A pair's key has the image, the tile and the bits of the depth, from the highest bit to the lowest.
"""

import torch
from torch import Tensor

from thermosplat.errors import UserError
from warp_kernels.constants import ALPHA_MIN

DEPTH_BITS = 32
"""Of a key, for the depth as a float32."""


@torch.no_grad()
def isect_tiles(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    radii: Tensor,  # [..., N, 2] or [nnz, 2]
    depths: Tensor,  # [..., N] or [nnz]
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Lists the tiles that each Gaussian touches, and sorts them by tile and depth; gsplat's function.

    Args:
        means2d: [..., N, 2], or packed [nnz, 2], px.
        radii: Half sizes of bounding boxes, [..., N, 2] or [nnz, 2], px; 0: culled.
        depths: [..., N] or [nnz].
        tile_size: Edge of a tile [px].
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.
        sort: Sort the pairs.
        segmented: Accepted for gsplat's sake; the result is the same.
        packed: The Gaussians are packed.
        n_images: Number of images of packed Gaussians.
        image_ids: Image of each packed Gaussian, [nnz].
        gaussian_ids: Accepted for gsplat's sake.
        conics: [..., N, 3] or [nnz, 3]; with ``opacities``, tiles are left out in which no pixel centre has an alpha of
            1/255, as in gsplat's main branch.
        opacities: [..., N] or [nnz].

    Returns:
        ``(tiles_per_gauss, isect_ids, flatten_ids)``: int32 [..., N] or [nnz]; keys, int64 [pairs]; flat index of each
        pair's Gaussian, int32 [pairs].

    Raises:
        UserError: packed Gaussians come without their images.
    """
    if packed and (n_images is None or image_ids is None):
        raise UserError("n_images and image_ids must be given with packed=True.")
    lead, per_image = means2d.shape[:-1], means2d.shape[-2]
    rows = means2d.numel() // 2
    if packed:
        images = image_ids.long()  # type: ignore[union-attr]
    else:
        images = torch.arange(rows, device=means2d.device) // max(per_image, 1)
    centers, reach = means2d.reshape(-1, 2) / tile_size, radii.reshape(-1, 2) / tile_size
    limits = torch.tensor([tile_width, tile_height], device=means2d.device)
    low = torch.minimum((centers - reach).floor().long().clamp(min=0), limits)
    high = torch.minimum((centers + reach).ceil().long().clamp(min=0), limits)
    size = (high - low).clamp(min=0)
    counts = size.prod(-1) * (radii.reshape(-1, 2) > 0).all(-1)
    flat = torch.repeat_interleave(counts)
    within = torch.arange(len(flat), device=flat.device) - (counts.cumsum(0) - counts)[flat]
    column = low[flat, 0] + within % size[flat, 0].clamp(min=1)
    row = low[flat, 1] + within // size[flat, 0].clamp(min=1)
    if conics is not None and opacities is not None:
        gaussians = means2d.reshape(-1, 2)[flat], conics.reshape(-1, 3)[flat], opacities.reshape(-1)[flat]
        touched = _touches(*gaussians, column, row, tile_size)
        flat, column, row = flat[touched], column[touched], row[touched]
        counts = torch.bincount(flat, minlength=rows)
    bits = depths.reshape(-1).float().contiguous().view(torch.int32)[flat].long() & (2**DEPTH_BITS - 1)
    tile_bits = (tile_width * tile_height).bit_length()
    keys = (((images[flat] << tile_bits) | (row * tile_width + column)) << DEPTH_BITS) | bits
    flat = flat.int()
    if sort:
        keys, order = torch.sort(keys, stable=True)
        flat = flat[order]
    return counts.reshape(lead).int(), keys, flat


def _touches(means2d: Tensor, conics: Tensor, opacities: Tensor, column: Tensor, row: Tensor, tile_size: int) -> Tensor:
    """For each pair whether alpha reaches 1/255 anywhere between the pixel centres at the tile's borders.

    The quadratic form is convex: its least value in a box is at the mean, if that is inside, or on an edge.
    """
    a, b, c = conics.unbind(-1)
    first = torch.stack([column, row], -1) * tile_size + 0.5 - means2d
    last = first + (tile_size - 1)
    inside = ((first <= 0) & (last >= 0)).all(-1)
    least = torch.full_like(a, torch.inf)
    for x in (first[:, 0], last[:, 0]):
        y = torch.minimum(torch.maximum(-b * x / c, first[:, 1]), last[:, 1])
        least = torch.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    for y in (first[:, 1], last[:, 1]):
        x = torch.minimum(torch.maximum(-b * y / a, first[:, 0]), last[:, 0])
        least = torch.minimum(least, a * x * x + 2 * b * x * y + c * y * y)
    least = torch.where(inside, 0.0, least)
    margin = 1.0 + 1e-5  # of the exponent: the blending rounds differently, and a pair too many costs time only
    return 0.5 * least <= margin * torch.log(opacities.clamp(min=1e-30) / ALPHA_MIN) + 1e-5


@torch.no_grad()
def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """First sorted pair of each tile; gsplat's function.

    Args:
        isect_ids: Sorted keys, int64 [pairs].
        n_images: I.
        tile_width: Tiles across the image.
        tile_height: Tiles down the image.

    Returns:
        int32 [I, tile_height, tile_width].
    """
    tiles = tile_width * tile_height
    numbers = torch.arange(n_images * tiles, device=isect_ids.device)
    keys = (torch.div(numbers, tiles, rounding_mode="floor") << tiles.bit_length()) | (numbers % tiles)
    found = torch.searchsorted(isect_ids >> DEPTH_BITS, keys)
    return found.int().reshape(n_images, tile_height, tile_width)
