"""Noting how many pairs a rasterization had, and whether there was room for them, in one launch."""

from typing import Any

import warp as wp

from warp_kernels.machinery.launching import launch_again

UNLIMITED = -1
"""Room that is made when the pairs are counted."""


@wp.kernel(name="note_pairs", enable_backward=False, module="unique")
def note_pairs_kernel(
    call: int,
    pairs_limit: wp.int64,
    listed_limit: wp.int64,
    totals: wp.array(dtype=wp.int64),  # [1] pairs, or [2] and the Gaussians that have any; [0] without Gaussians
    # inputs and outputs
    most_pairs: wp.array(dtype=wp.int64),  # [calls]
    most_listed: wp.array(dtype=wp.int64),  # [calls]
    overflow: wp.array(dtype=wp.float32),  # [1]
):
    """One thread: the first total is that of the pairs, the second, where there is one, that of the Gaussians."""
    for k in range(totals.shape[0]):
        total = totals[k]
        limit = pairs_limit
        if k == 0:
            most_pairs[call] = wp.max(most_pairs[call], total)
        else:
            limit = listed_limit
            most_listed[call] = wp.max(most_listed[call], total)
        if limit >= wp.int64(0) and total > limit:
            overflow[0] = 1.0


def note_pairs(
    call: int, limits: tuple[int, int], totals: Any, most_pairs: Any, most_listed: Any, overflow: Any
) -> None:
    """Notes the totals of one rasterization.

    Args:
        call: its number in the step, from 0.
        limits: pairs and Gaussians there was room for, or ``UNLIMITED``.
        totals: int64 [1] pairs, or [2] and the Gaussians that have any; [0] without Gaussians.
        most_pairs: int64 [calls], raised to the pairs in its place of this call.
        most_listed: int64 [calls], raised to the Gaussians.
        overflow: float32 [1]; gets 1 where a total is above its limit, and else stays as it is.
    """
    launch_again(note_pairs_kernel, 1, [call, *limits, totals, most_pairs, most_listed, overflow], totals.device)
