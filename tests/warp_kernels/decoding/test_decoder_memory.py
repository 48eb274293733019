"""What a block that decodes holds in shared memory."""

import itertools

import pytest

from warp_kernels.decoding.decoder_memory import INPUTS, NARROW, TEAMS, WARPS, layout_of, padded_inputs
from warp_kernels.decoding.decoder_networks import HIDDEN
from warp_kernels.decoding.matrix_fragments import PIXELS, row_bytes

STATIC = 1024
"""Bytes of a block that Warp takes for itself, four a thread."""

ALLOWED = {1: 163 * 1024 - STATIC, 2: 99 * 1024 - STATIC}
"""Bytes that remain where a warp has 16 pixels to itself (compute capability 8.0), and where two share them (8.6)."""


@pytest.mark.parametrize("team", TEAMS)
@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("modulated", [False, True])
def test_nothing_overlaps(hidden: int, modulated: bool, inputs: int, team: int) -> None:
    """Matrices lie one behind the other on 16-byte boundaries; the forward pass has the weights only."""
    at = layout_of(hidden, modulated, inputs, team)
    pixels = WARPS // team * PIXELS
    ends = {
        at.w1: hidden * row_bytes(inputs),
        at.w2: hidden * row_bytes(hidden),
        at.w3: hidden * row_bytes(hidden),
        at.modulation: 2 * hidden * row_bytes(hidden) if modulated else 0,
        at.head: NARROW * row_bytes(hidden),
        at.features: pixels * row_bytes(inputs),
        at.first: pixels * row_bytes(hidden),
        at.encoded: pixels * row_bytes(hidden),
        at.prior: pixels * row_bytes(hidden),
        at.v_image: pixels * row_bytes(NARROW),
        at.factors[0]: pixels * row_bytes(hidden),
        at.factors[1]: pixels * row_bytes(hidden),
    }
    starts = sorted(ends)
    assert all(start + ends[start] <= following for start, following in itertools.pairwise(starts))
    assert all(start % 16 == 0 for start in starts)
    assert starts[-1] + ends[starts[-1]] == at.size
    assert at.b_head < at.forward_size <= at.features
    assert at.size <= ALLOWED[team]
    assert at.forward_size == layout_of(hidden, modulated, inputs).forward_size


@pytest.mark.parametrize(("channels", "inputs"), [(1, 16), (15, 16), (16, 32), (31, 32), (32, None)])
def test_columns_have_room_for_features_and_a_1(channels: int, inputs: int | None) -> None:
    """The narrowest that has, and none beyond the widest."""
    assert padded_inputs(channels) == inputs
