"""The pairs that a rasterization had, noted by one Warp kernel."""

import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import view, warp_device_of
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.binning.pair_notes import UNLIMITED, note_pairs
from warp_kernels.machinery.array_views import ArrayView


def note_totals(
    call: int, limits: tuple[int, int] | None, totals: Tensor, most: Tensor, most_listed: Tensor, overflow: Tensor
) -> None:
    """Note the totals of one rasterization, in place. Never waits for the device.

    Args:
        call: Its number in the step, from 0.
        limits: Pairs and Gaussians there was room for; None: for all.
        totals: int64, [1] all pairs, or [2] and the Gaussians that have any; [0] without Gaussians.
        most: int64, by call; raised to the pairs.
        most_listed: int64, by call; raised to the Gaussians.
        overflow: float32 scalar, on the device or in the host's pinned memory; gets 1 where a total is above its limit,
            and else stays as it is.
    """
    with launches_on_torch_stream(totals.device):
        counts = [view(tensor, wp.int64) for tensor in (totals, most, most_listed)]
        seen_there = ArrayView(overflow.data_ptr(), (1,), wp.float32, warp_device_of(totals.device))
        note_pairs(call, limits or (UNLIMITED, UNLIMITED), *counts, seen_there)
