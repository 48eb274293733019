"""The step that lists the Gaussians of each tile in depth order: its launches, sorts and scan. No gradient."""

import functools
from collections.abc import Callable

import warp as wp

from warp_kernels.binning.tile_binning import MASK_SHIFT, Totals, binning_kernels
from warp_kernels.binning.tile_bins import Room, TileBins
from warp_kernels.binning.tile_ranges import tile_ranges_kernel
from warp_kernels.machinery.array_views import empty, memory, nothing
from warp_kernels.machinery.lanes import lanes_of, whole_warps
from warp_kernels.machinery.launching import launch, launch_again
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
        projected: from ``project``. Radii of Gaussians with non-finite features are set to zero.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same array where there is one opacity.
        features: scalar array [images · N, D], only checked for being finite.
        settings: image size.
        tile_size: edge of a tile [px].
        by_slot: number the pairs, for an adjoint that writes one record per pair.
        rest: as ``features``, channels that lie apart from them; None: there are no others.
        room: None for as many pairs as there are.

    Returns:
        The bins.

    Raises:
        TooManyPairsError: for more pairs, or room for more, than ``PAIRS_MAX``, or more tiles than ``TILES_MAX``.
    """
    device, dtype = opacities.device, opacities.dtype
    lanes = lanes_of(device)
    count_kernel, compact_kernel, gather_kernel, emit_kernel = binning_kernels(dtype, lanes)
    entries = projected.means2d.shape[0]
    tiles_x, tiles_y = -(-settings.width // tile_size), -(-settings.height // tile_size)
    num_tiles = settings.num_images * tiles_x * tiles_y

    tiles_per_gaussian = empty(entries, wp.int32, device)
    counted = [
        settings.width,
        settings.height,
        tile_size,
        projected.means2d,
        projected.roots,
        projected.extents,
        projected.depths,
        opacities,
        thermal_opacities,
        features,
        rest,
        projected.radii,
        tiles_per_gaussian,
    ]
    compacted, ranks, totals = entries > COMPACTED, entries, None
    num_pairs = None if room is None else room.pairs
    if num_tiles > TILES_MAX:
        raise TooManyPairsError(f"{num_tiles:,} tiles of {tile_size} px exceed the {TILES_MAX:,} of one call.")
    overlaps = functools.partial(_overlaps, settings, num_tiles, tile_size)
    if num_pairs is not None:
        _check_pairs(num_pairs, overlaps)
    if compacted:
        totals = empty(-(-entries // lanes), Totals, device)
        launch(count_kernel, whole_warps(entries, device), [*counted, totals, None, None], device)
        wp.utils.array_scan(totals, totals, inclusive=True)
        if room is None:
            num_pairs, ranks = memory.source.last(totals)
            _check_pairs(num_pairs, overlaps)  # before room for ranks, of which each has one at least
        else:
            ranks = min(entries, room.pairs, room.gaussians)
    # radix_sort_pairs sorts in place and needs room for a second copy
    depth_keys, unsorted = empty(2 * ranks, dtype, device), empty(2 * ranks, wp.int32, device)
    if compacted:
        inputs = [ranks, tiles_per_gaussian, totals, projected.depths, depth_keys, unsorted]
        launch(compact_kernel, threads_of_many(entries) if device.is_cuda else entries, inputs, device)
    else:
        launch(count_kernel, whole_warps(entries, device), [*counted, None, depth_keys, unsorted], device)
    order, pair_ends = empty(ranks, wp.int32, device), empty(ranks, wp.int64, device)
    if ranks > 0:
        sort_by_depth(depth_keys, unsorted, ranks)
        launch_again(gather_kernel, ranks, [unsorted, tiles_per_gaussian, order, pair_ends], device)
        wp.utils.array_scan(pair_ends, pair_ends, inclusive=True)
    if num_pairs is None:
        num_pairs = memory.source.last(pair_ends) if ranks > 0 else 0
        _check_pairs(num_pairs, overlaps)
    del depth_keys, unsorted

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
            f"While making room for {overlaps(num_pairs)}, about "
            f"{(6 if by_slot else 5) * 4 * num_pairs / 2**20:,.0f} MiB on {device}."
        )
        raise
    masked = masks.shape[0] > 0 and num_tiles < 2**MASK_SHIFT
    if num_pairs > 0:
        if room is not None:
            # Places that stay empty carry a tile after the last and sort to the end.
            memory.source.fill(keys, num_pairs, num_tiles)
        launch(
            emit_kernel,
            whole_warps(ranks, device),
            [
                settings.num_gaussians,
                settings.width,
                settings.height,
                tile_size,
                tiles_x,
                tiles_y,
                by_slot,
                masked,
                num_pairs,
                projected.means2d,
                projected.roots,
                projected.extents,
                opacities,
                thermal_opacities,
                order,
                tiles_per_gaussian,
                pair_ends,
                keys,
                values,
                owners,
            ],
            device,
        )
        wp.utils.radix_sort_pairs(keys, values, num_pairs, 0, max(1, num_tiles.bit_length()))
    launch_again(
        tile_ranges_kernel,
        num_pairs + 1,
        [num_pairs, num_tiles, by_slot, masked, pair_ends, keys, values, owners, tile_offsets, gaussian_ids, masks],
        device,
    )
    return TileBins(
        gaussian_ids=gaussian_ids,
        masks=masks,
        tile_offsets=tile_offsets,
        order=order,
        pair_ends=pair_ends,
        totals=totals,
        tiles_per_gaussian=tiles_per_gaussian,
        slots=values if by_slot else None,
        num_pairs=num_pairs,
        expected_pairs=num_pairs if room is None else room.expected_pairs,
        tile_size=tile_size,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
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


def _overlaps(settings: ProjectionSettings, num_tiles: int, tile_size: int, num_pairs: int) -> str:
    """The pairs in words."""
    tiles = f"{num_tiles:,} tiles of {tile_size} px"
    return f"{num_pairs:,} overlaps of {settings.num_gaussians:,} Gaussians with {tiles}"


def _check_pairs(num_pairs: int, overlaps: Callable[[int], str]) -> None:
    """Refuses more pairs, or room for more, than can be numbered."""
    if num_pairs > PAIRS_MAX:
        raise TooManyPairsError(f"{overlaps(num_pairs)} exceed the {PAIRS_MAX:,} that one call can number.")
