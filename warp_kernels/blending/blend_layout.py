"""How a tile's pixels are dealt to lanes: the one difference between the CPU's and CUDA's blending kernels.

A tile is cut into blocks, each owned by one warp (``lanes`` lanes, 32 on CUDA, 1 on the CPU). A lane owns
``rows * columns`` pixels: on the CPU all rows of the tile, so that a Gaussian's rows can be walked alone and clang
vectorises the loop over columns; on CUDA one "row" of a few pixels, unrolled into registers.
"""

import functools
from dataclasses import dataclass

import warp as wp

from warp_kernels.machinery.lanes import LANES_CUDA

WIDEST_VECTORS = "-mprefer-vector-width=512"
"""Of clang, for any target; without AVX-512 it changes nothing."""


@dataclass(frozen=True)
class BlendLayout:
    """Deal of pixels to lanes; compile-time parameters of the blending kernels.

    Attributes:
        tile_size: edge of a tile [px].
        block_width: width of the block one warp owns [px].
        block_height: height of the block one warp owns [px].
        lanes: lanes in a warp: 32 on CUDA, 1 on the CPU.
        segment: pairs of a long list that one block of threads walks, a multiple of 32; 0: lists are not cut.
    """

    tile_size: int
    block_width: int
    block_height: int
    lanes: int
    segment: int = 0

    @functools.cached_property
    def blocks_x(self) -> int:
        """Blocks across a tile."""
        return self.tile_size // self.block_width

    @functools.cached_property
    def warps(self) -> int:
        """Warps in a tile."""
        return self.blocks_x * (self.tile_size // self.block_height)

    @property
    def rows(self) -> int:
        """Rows of pixels a lane walks one after the other."""
        return self.block_height if self.lanes == 1 else 1

    @property
    def columns(self) -> int:
        """Pixels of a lane in each of its rows."""
        return self.block_width * self.block_height // (self.lanes * self.rows)

    @functools.cached_property
    def threads(self) -> int:
        """Threads of a tile, which are one CUDA block."""
        return self.warps * self.lanes

    @property
    def tag(self) -> str:
        """Part of a kernel's name; ``segment`` is an argument of the kernels."""
        return f"{self.tile_size}_{self.block_width}x{self.block_height}_{self.lanes}"

    def module_options(self, *, widest_vectors: bool) -> dict:
        """Warp options of a blending kernel.

        Args:
            widest_vectors: on a CPU with AVX-512, 16 pixels at once and not 8, as clang prefers. The adjoint keeps too
                many sums of each pixel in registers for that.
        """
        # No fast_math: the adjoint divides its way back through the transmittance, and approximate division would let
        # the error grow with every layer.
        options: dict = {"block_dim": self.threads, "fast_math": False, "max_unroll": 64}
        return options | (vectorized(self.columns, widest=widest_vectors) if self.lanes == 1 else {})


def vectorized(columns: int, *, widest: bool = True) -> dict:
    """Warp options of a kernel for CPUs whose innermost loop over so many pixels is to become vectors."""
    # The loop must stay rolled, or clang does not vectorise it.
    options: dict = {"max_unroll": min(15, columns - 1)}
    if widest:
        flags = wp.config.cpu_compiler_flags
        options["cpu_compiler_flags"] = f"{'-march=native' if flags is None else flags} {WIDEST_VECTORS}"
    return options


_layout = functools.lru_cache(maxsize=256)(BlendLayout)
"""The same object for the same deal: what follows from it is worked out once."""

CROWDED = 250
"""Mean pairs a tile above which the smallest block blends fastest on CUDA; measured in benchmarks/notes/blending.md."""

WIDE = 24
"""Channels above which a pixel's sums take most of the registers."""

FEW_TILES = 4096
"""Tiles up to which the longest list decides how long blending takes, so that it is cut; more fill a GPU ..."""

SHORT_LISTS = 400
"""Mean pairs of a tile up to which hardly a list is long enough to be cut."""

LONG_LISTS, LONG_LISTS_THERMAL = 9, 5
"""... unless they are fewer than so many times the mean pairs of one; with two opacities a cut costs more."""

LONGEST_LISTS = 1.5
"""Where they are fewer than so many times the mean pairs of one, many lists are cut, into shorter segments."""

SEGMENTS = 2500
"""Segments that fill a GPU ..."""

SHORTEST, LONGEST = 256, 1024
"""... and the pairs of one: shorter ones cost more states and joints than they bring."""


def default_layout(
    device: wp.Device,
    tile_size: int,
    channels: int,
    thermal_channels: int,
    dtype: type,
    num_pairs: int,
    num_tiles: int,
) -> BlendLayout:
    """The layout measured best for a device and a frame; see benchmarks/notes/blending.md.

    Args:
        tile_size: edge of a tile [px].
        thermal_channels: channels blended with the second, or 0.
        num_pairs: (Gaussian, tile) pairs of the frame.
    """
    if not device.is_cuda:
        return _layout(tile_size, tile_size, tile_size, 1)
    # Crowded tiles are decided by culling, which is sharper for a small block; sparse ones by how often a Gaussian's
    # gradient is reduced over a warp, which a large block does less often. float64 has half the registers.
    mean_pairs = num_pairs / max(num_tiles, 1)
    crowded, few_tiles = mean_pairs > CROWDED, num_tiles <= FEW_TILES
    wide = channels + thermal_channels > WIDE
    width, height = 8, 8
    if dtype is wp.float64 or (crowded and not wide):
        height = 4
    elif wide and not crowded and not few_tiles:
        width = 16
    if tile_size == 32:
        height = 8  # records of more warps would not fit in shared memory
    long_lists = LONG_LISTS_THERMAL if thermal_channels else LONG_LISTS
    longest_decides = mean_pairs > SHORT_LISTS and (few_tiles or num_tiles < long_lists * mean_pairs)
    segment = LONGEST if longest_decides else 0
    if num_tiles < LONGEST_LISTS * mean_pairs:
        segment = min(max(num_pairs // SEGMENTS // SHORTEST * SHORTEST, SHORTEST), LONGEST)
    return _layout(tile_size, min(width, tile_size), height, LANES_CUDA, segment)
