"""The step that lists the Gaussians of each tile in depth order: its launches, sorts and scan. No gradient."""

from typing import NamedTuple

import warp as wp

from warp_kernels.binning.tile_binning import MASK_SHIFT, Totals, binning_kernels
from warp_kernels.binning.tile_bins import Room, TileBins
from warp_kernels.binning.tile_ranges import FILLING, fill_room_kernel, tile_ranges_kernel
from warp_kernels.machinery.array_views import empty, memory, nothing
from warp_kernels.machinery.lanes import lanes_of, whole_warps
from warp_kernels.machinery.launching import SMALL_BLOCK, launch, launch_again
from warp_kernels.machinery.warp_lists import threads_of_many
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings

COMPACTED = 2**18
"""Gaussians above which those without tiles are left out before the sort by depth; fewer are sorted in no time."""

FEW_SORTED, DIGIT = 8192, 11
"""On the CPU so few keys are sorted by so many bits at a time: Warp's 16 need counts that do not fit fast caches."""

PAIRS_MAX = 2**30 - 1
"""Pairs of a call, at most: sorting takes two copies of them in one array, of fewer than 2**31 numbers."""

TILES_MAX = 2**31 - 2
"""Tiles of a call, at most: their offsets, of which there is one more, are in such an array too."""


class TooManyPairsError(ValueError):
    """More (Gaussian, tile) pairs, or tiles, than a call can number."""


def wants_masks(device: wp.Device) -> bool:
    """Whether the blending asks which parts of a tile a pair reaches: on the CPU a lane has all of the tile."""
    return device.is_cuda


def bin_tiles(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    settings: ProjectionSettings,
    tile_size: int,
    *,
    by_slot: bool,
    rest: wp.array | None = None,
    room: Room | None = None,
) -> TileBins:
    """Lists the Gaussians of each tile in depth order.

    Without a ``room`` the number of pairs is read back to the host once, and every pair is listed. With it nothing is
    read back, so that the step can be captured in a CUDA graph; pairs beyond it, those of the farthest Gaussians, are
    left out, as are the last Gaussians where there are too many; the last entry of ``bins.totals``, or of
    ``bins.pair_ends`` where that is None, says how many were needed.

    Args:
        projected: from ``project_gaussians``. Gaussians with non-finite features become invisible.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same array where there is one opacity.
        features: scalar array [images · N, D], only checked for being finite.
        settings: image size.
        tile_size: edge of a tile [px], a power of two.
        by_slot: number the pairs, for an adjoint that writes one record per pair.
        rest: as ``features``, channels that lie apart from them; None: there are no others.
        room: None for as many pairs as there are.

    Raises:
        TooManyPairsError: for more pairs, or room for more, than ``PAIRS_MAX``, or more tiles than ``TILES_MAX``.
        ValueError: if the tile size is no power of two.
    """
    drawn = (projected, opacities, thermal_opacities)
    nearest_first = sort_gaussians(*drawn, features, settings, tile_size, rest=rest, room=room)
    return list_pairs(*drawn, nearest_first, by_slot=by_slot, room=room)


class _Grid(NamedTuple):
    """The tiles of all images."""

    settings: ProjectionSettings
    tile_size: int
    tiles_x: int
    tiles_y: int
    num_tiles: int

    def overlaps(self, num_pairs: int) -> str:
        """The pairs in words."""
        tiles = f"{self.num_tiles:,} tiles of {self.tile_size} px"
        return f"{num_pairs:,} overlaps of {self.settings.num_gaussians:,} Gaussians with {tiles}"

    def check(self, num_pairs: int) -> None:
        """Refuses more pairs, or room for more, than can be numbered."""
        if num_pairs > PAIRS_MAX:
            message = f"{self.overlaps(num_pairs)} exceed the {PAIRS_MAX:,} that one call can number."
            raise TooManyPairsError(message)


class SortedGaussians(NamedTuple):
    """The Gaussians of all images, nearest first: those that touch a tile, or all where there are few."""

    grid: _Grid
    """The tiles that they were counted in."""
    order: wp.array
    """Flat index of each, int32 [ranks]."""
    pair_ends: wp.array
    """Pairs of the Gaussians up to each, itself included, int64 [ranks]."""
    ranks: int
    num_pairs: int
    """Pairs of all, or the room for them."""
    tiles_per_gaussian: wp.array
    """int32 [images · N]."""
    totals: wp.array | None
    """Where some Gaussians were left out: running sums of pairs and Gaussians, a warp of Gaussians an entry."""


def sort_gaussians(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    settings: ProjectionSettings,
    tile_size: int,
    *,
    rest: wp.array | None = None,
    room: Room | None = None,
) -> SortedGaussians:
    """The first half of ``bin_tiles``, with its arguments: afterwards it is known how many pairs there are.

    It counts the tiles of each Gaussian, leaves out those without (if there are many), and sorts by depth.
    """
    if tile_size < 1 or tile_size & (tile_size - 1):
        raise ValueError(f"tile_size must be a power of two, got {tile_size}.")
    tiles_x, tiles_y = -(-settings.width // tile_size), -(-settings.height // tile_size)
    grid = _Grid(settings, tile_size, tiles_x, tiles_y, settings.num_images * tiles_x * tiles_y)
    if grid.num_tiles > TILES_MAX:
        raise TooManyPairsError(f"{grid.num_tiles:,} tiles of {tile_size} px exceed the {TILES_MAX:,} of one call.")
    if room is not None:
        grid.check(room.pairs)
    device, dtype = opacities.device, opacities.dtype
    count_kernel, compact_kernel, gather_kernel, _ = binning_kernels(dtype, lanes_of(device))
    entries = projected.means2d.shape[0]
    tiles_per_gaussian = empty(entries, wp.int32, device)
    counted = [
        grid.settings.width,
        grid.settings.height,
        grid.tile_size,
        projected.means2d,
        projected.roots,
        projected.extents,
        projected.depths,
        opacities,
        thermal_opacities,
        features,
        rest,
        projected.visible,
        tiles_per_gaussian,
    ]
    compacted, ranks, totals = entries > COMPACTED, entries, None
    num_pairs = None if room is None else room.pairs
    if compacted:
        totals = empty(-(-entries // lanes_of(device)), Totals, device)
        launch(count_kernel, whole_warps(entries, device), [*counted, totals, None, None], device, SMALL_BLOCK)
        wp.utils.array_scan(totals, totals, inclusive=True)
        if room is None:
            num_pairs, ranks = memory.source.last(totals)
            grid.check(num_pairs)  # before room for ranks, of which each has one at least
        else:
            ranks = min(entries, room.pairs, room.gaussians)
    # radix_sort_pairs sorts in place and needs room for a second copy
    depth_keys, unsorted = empty(2 * ranks, dtype, device), empty(2 * ranks, wp.int32, device)
    if compacted:
        inputs = [ranks, tiles_per_gaussian, totals, projected.depths, depth_keys, unsorted]
        launch(compact_kernel, threads_of_many(entries) if device.is_cuda else entries, inputs, device)
    else:
        launch(count_kernel, whole_warps(entries, device), [*counted, None, depth_keys, unsorted], device, SMALL_BLOCK)
    order, pair_ends = empty(ranks, wp.int32, device), empty(ranks, wp.int64, device)
    if ranks > 0:
        sort_by_depth(depth_keys, unsorted, ranks)
        launch_again(gather_kernel, ranks, [unsorted, tiles_per_gaussian, order, pair_ends], device)
        wp.utils.array_scan(pair_ends, pair_ends, inclusive=True)
    if num_pairs is None:
        num_pairs = memory.source.last(pair_ends) if ranks > 0 else 0
        grid.check(num_pairs)
    return SortedGaussians(grid, order, pair_ends, ranks, num_pairs, tiles_per_gaussian, totals)


def list_pairs(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    nearest_first: SortedGaussians,
    *,
    by_slot: bool,
    room: Room | None = None,
) -> TileBins:
    """The second half of ``bin_tiles``.

    It emits the pairs in the order of the Gaussians, sorts them by tile, and finds where each tile begins.

    Args:
        projected: as in ``bin_tiles``, as are all other arguments.
        nearest_first: from ``sort_gaussians``.
    """
    grid = nearest_first.grid
    device, settings = opacities.device, grid.settings
    num_pairs, num_tiles = nearest_first.num_pairs, grid.num_tiles
    try:
        keys = empty(2 * num_pairs, wp.int32, device)
        values = empty(2 * num_pairs, wp.int32, device)
        owners = empty(num_pairs, wp.int32, device) if by_slot else None
        gaussian_ids = empty(num_pairs, wp.int32, device)
        masks = empty(num_pairs, wp.uint8, device) if wants_masks(device) else nothing(wp.uint8, 1, device)
        tile_offsets = empty(num_tiles + 1, wp.int32, device)
    except Exception as error:
        # Of what kind depends on the allocator; what was asked for is known here only.
        error.add_note(
            f"While making room for {grid.overlaps(num_pairs)}, about "
            f"{(6 if by_slot else 5) * 4 * num_pairs / 2**20:,.0f} MiB on {device}."
        )
        raise
    masked = masks.shape[0] > 0 and num_tiles < 2**MASK_SHIFT
    if num_pairs > 0:
        if room is not None and nearest_first.ranks > 0:
            launch_again(fill_room_kernel, FILLING, [num_tiles, num_pairs, nearest_first.pair_ends, keys], device)
        *_, emit_kernel = binning_kernels(opacities.dtype, lanes_of(device))
        launch(
            emit_kernel,
            whole_warps(nearest_first.ranks, device),
            [
                settings.num_gaussians,
                settings.width,
                settings.height,
                grid.tile_size,
                grid.tiles_x,
                grid.tiles_y,
                by_slot,
                masked,
                num_pairs,
                projected.means2d,
                projected.roots,
                projected.extents,
                opacities,
                thermal_opacities,
                nearest_first.order,
                nearest_first.pair_ends,
                keys,
                values,
                owners,
            ],
            device,
            SMALL_BLOCK,
        )
        wp.utils.radix_sort_pairs(keys, values, num_pairs, 0, max(1, num_tiles.bit_length()))
    ends = nearest_first.pair_ends
    launch_again(
        tile_ranges_kernel,
        num_pairs + 1,
        [num_pairs, num_tiles, by_slot, masked, ends, keys, values, owners, tile_offsets, gaussian_ids, masks],
        device,
    )
    return TileBins(
        gaussian_ids=gaussian_ids,
        masks=masks,
        tile_offsets=tile_offsets,
        order=nearest_first.order,
        pair_ends=ends,
        totals=nearest_first.totals,
        tiles_per_gaussian=nearest_first.tiles_per_gaussian,
        slots=values if by_slot else None,
        num_pairs=num_pairs,
        expected_pairs=num_pairs if room is None else room.expected_pairs,
        has_room=room is not None,
        tile_size=grid.tile_size,
        tiles_x=grid.tiles_x,
        tiles_y=grid.tiles_y,
    )


def sort_by_depth(keys: wp.array, values: wp.array, count: int) -> None:
    """Sorts pairs by a whole key, in place; equal keys stay in their order.

    Args:
        keys: [2 count] of float32 or float64, of which the first half is sorted and the other is room.
        values: int32 [2 count].
        count: pairs.
    """
    bits = 32 if keys.dtype is wp.float32 else 64
    digit = DIGIT if count <= FEW_SORTED and keys.device.is_cpu else bits
    for first in range(0, bits, digit):
        wp.utils.radix_sort_pairs(keys, values, count, first, min(first + digit, bits))
