"""What the blending's kernels are given, in structs, and the block of pixels that a warp has.

A launch takes a struct's fields one after the other; see ``machinery.launching``.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.machinery.loading import made_once


@wp.struct
class TileGrid:
    """The tiles of an image, and its size [px]."""

    tiles_x: int
    tiles_y: int
    width: int
    height: int


@wp.struct
class SortedPairs:
    """The lists of all tiles, one behind the other."""

    gaussian_ids: wp.array(dtype=wp.int32)  # [pairs]
    masks: wp.array(dtype=wp.uint8)  # [pairs]; read on CUDA alone
    tile_offsets: wp.array(dtype=wp.int32)  # [tiles + 1]
    segment: int
    cuts: wp.array(dtype=wp.int32)  # [tiles + rows + 1]; [0]: no list is cut; see list_segments


@made_once
def splats_type(first_channels: int, others: int, dtype: type) -> Any:
    """The struct of projected Gaussians with what is blended of them.

    Args:
        first_channels: A, channels of the first array of features.
        others: B, channels of the other; 1 where there is none.
    """
    vec2, vec4 = wp.types.vector(2, dtype), wp.types.vector(4, dtype)
    vecA, vecB = wp.types.vector(first_channels, dtype), wp.types.vector(others, dtype)

    @wp.struct
    class Splats:
        means2d: wp.array(dtype=vec2)  # [images · N]
        packed_roots: wp.array(dtype=vec4)  # [images · N]
        extents: wp.array(dtype=vec2)  # [images · N]; read on the CPU alone
        opacities: wp.array(dtype=dtype)  # [images · N]
        thermal_opacities: wp.array(dtype=dtype)  # [images · N]; read where there are two opacities
        features: wp.array(dtype=vecA)  # [images · N]
        rest: wp.array(dtype=vecB)  # [images · N]; [0]: there are no other channels

    return Splats


@made_once
def pixel_ends_type(dtype: type) -> Any:
    """The struct of images that say where each pixel's walk with one opacity ended."""

    @wp.struct
    class PixelEnds:
        transmittance: wp.array2d(dtype=dtype)  # [images · height, width]
        ends: wp.array2d(dtype=wp.int32)  # [images · height, width]; see pixel_ends
        alphas: wp.array2d(dtype=dtype)  # [images · height, width]; [0, 0]: there are none

    return PixelEnds


class BlockFunctions(NamedTuple):
    """Warp functions of a warp's block of pixels.

    Attributes:
        corner_of: the block's first pixel (x, y), given the tile, the warp and the grid.
        middle_of: the pixel in its middle, from which pixels and means are seen.
        centres: pixel centres of the lane's row as seen from there, x and y.
    """

    corner_of: Any
    middle_of: Any
    centres: Any


@made_once
def block_functions(dtype: type, layout: BlendLayout) -> BlockFunctions:
    """Which pixels a warp and its lanes have."""
    lanes, columns, blocks_x, tile_size = layout.lanes, layout.columns, layout.blocks_x, layout.tile_size
    block_width, block_height = layout.block_width, layout.block_height
    half, vecQ = dtype(0.5), wp.types.vector(columns, dtype)

    @wp.func
    def corner_of(tile: int, warp: int, grid: TileGrid):
        in_image = tile % (grid.tiles_x * grid.tiles_y)
        x = (in_image % grid.tiles_x) * tile_size + (warp % blocks_x) * block_width
        y = (in_image // grid.tiles_x) * tile_size + (warp // blocks_x) * block_height
        return x, y

    @wp.func
    def middle_of(block_x: int, block_y: int, grid: TileGrid):
        """On the CPU, where a block is a tile, of the part that lies in the image."""
        across, down = int(block_width), int(block_height)
        if wp.static(layout.lanes == 1):
            across, down = wp.min(across, grid.width - block_x), wp.min(down, grid.height - block_y)
        return block_x + across // 2, block_y + down // 2

    @wp.func
    def centres(lane: int, from_corner_x: int, from_corner_y: int):
        x0 = half - dtype(from_corner_x)
        y0 = half - dtype(from_corner_y)
        x = vecQ()
        y = vecQ()
        for q in range(columns):
            x[q] = x0 + dtype((lane + q * lanes) % block_width)
            y[q] = y0 + dtype((lane + q * lanes) // block_width)
        return x, y

    return BlockFunctions(corner_of, middle_of, centres)
