"""What a list of pairs has behind its last pair, and where the pairs of each tile lie once it is sorted by tile."""

import warp as wp

from warp_kernels.binning.tile_binning import MASK_SHIFT

FILLING = 2**15
"""Threads that fill what the pairs have left of their room."""


@wp.kernel(enable_backward=False, module="unique")
def fill_room_kernel(
    num_tiles: int,
    capacity: int,
    pair_ends: wp.array(dtype=wp.int64),  # [ranks]
    # outputs
    keys: wp.array(dtype=wp.int32),  # [2 · capacity], the first half
):
    """Gives places behind the last pair a tile after the last, so that they sort to the end; threads: ``FILLING``."""
    num_pairs = wp.min(pair_ends[pair_ends.shape[0] - 1], wp.int64(capacity))
    for place in range(int(num_pairs) + wp.tid(), capacity, wp.static(FILLING)):
        keys[place] = num_tiles


@wp.kernel(enable_backward=False, module="unique")
def tile_ranges_kernel(
    capacity: int,
    num_tiles: int,
    by_slot: bool,
    masked: bool,
    pair_ends: wp.array(dtype=wp.int64),  # [ranks]
    keys: wp.array(dtype=wp.int32),  # [2 · capacity], the first half
    values: wp.array(dtype=wp.int32),  # [2 · capacity], the first half
    owners: wp.array(dtype=wp.int32),  # [capacity]; [0] without by_slot
    # outputs
    tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
    gaussian_ids: wp.array(dtype=wp.int32),  # [capacity]
    masks: wp.array(dtype=wp.uint8),  # [capacity]; [0]: not wanted
):
    """Offsets of each tile's pairs in the sorted list, and each sorted pair's Gaussian and mask; threads: capacity + 1.

    Without ``masked`` keys are tiles, and masks, where wanted, all of a tile.
    """
    tile_bits = wp.where(masked, wp.static(2**MASK_SHIFT - 1), -1)
    k = wp.tid()
    num_pairs = int(0)
    if pair_ends.shape[0] > 0:
        num_pairs = int(wp.min(pair_ends[pair_ends.shape[0] - 1], wp.int64(capacity)))
    if k > num_pairs:
        return
    tile = num_tiles
    if k < num_pairs:
        tile = keys[k] & tile_bits
        if by_slot:
            gaussian_ids[k] = owners[values[k]]
        else:
            gaussian_ids[k] = values[k]
        if masks.shape[0] > 0:
            masks[k] = wp.uint8(wp.where(masked, keys[k] >> wp.static(MASK_SHIFT), -1))
    previous = int(-1)
    if k > 0:
        previous = keys[k - 1] & tile_bits
    while previous < tile:
        previous += 1
        tile_offsets[previous] = k
