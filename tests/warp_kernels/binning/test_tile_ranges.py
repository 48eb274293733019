"""Where each tile's pairs lie in the sorted list."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning.tile_binning import MASK_SHIFT
from warp_kernels.binning.tile_ranges import tile_ranges_kernel

TILES = 6


def array(values: np.ndarray, dtype: type) -> wp.array:
    return wp.array(values, dtype=dtype, device="cpu")


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("by_slot", [False, True])
@pytest.mark.parametrize("room", [9, 14, 5])
def test_offsets_ids_and_masks(masked: bool, by_slot: bool, room: int) -> None:
    """Empty tiles before, between and after; more room than pairs, and less."""
    tiles = np.array([1, 1, 1, 2, 4, 4, 4, 4, 4])
    values, owners, masks = np.arange(9)[::-1], 100 + np.arange(9), 17 * np.arange(1, 10)
    listed = min(room, len(tiles))
    filled = np.full(room, TILES)
    filled[:listed] = (tiles | masks << MASK_SHIFT if masked else tiles)[:listed]
    padded = np.zeros(room, np.int32)
    padded[:listed] = values[:listed]
    offsets, ids = wp.zeros(TILES + 1, dtype=wp.int32, device="cpu"), wp.zeros(room, dtype=wp.int32, device="cpu")
    found_masks = wp.zeros(room, dtype=wp.uint8, device="cpu")
    inputs = [room, TILES, by_slot, masked, array(np.array([4, 9]), wp.int64), array(filled, wp.int32)]
    inputs += [array(padded, wp.int32), array(owners, wp.int32)]
    wp.launch(tile_ranges_kernel, room + 1, inputs, [offsets, ids, found_masks], device="cpu")
    expected = [np.searchsorted(tiles[:listed], tile) for tile in range(TILES + 1)]
    assert offsets.numpy().tolist() == expected
    assert ids.numpy()[:listed].tolist() == (owners[values] if by_slot else values)[:listed].tolist()
    assert found_masks.numpy()[:listed].tolist() == (masks[:listed] if masked else np.full(listed, 255)).tolist()
