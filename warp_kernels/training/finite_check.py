"""Noting which of many tensors first held something that is not finite."""

import warp as wp

from warp_kernels.machinery.tensor_tables import (
    Addresses,
    Counts,
    load_quad,
    share_of,
)

LARGEST = 1.8e19
"""Largest number that passes: beyond it the square, which Adam keeps, is infinite."""


@wp.kernel(name="note_bad", enable_backward=False, module="unique")
def note_bad_kernel(
    ends: Counts,
    sizes: Counts,
    names: Counts,
    tensors: Addresses,
    step: wp.array(dtype=wp.int64),  # [1]
    # inputs and outputs
    first_bad_step: wp.array(dtype=wp.int64),  # [names]
    # outputs
    blocked: wp.array(dtype=wp.float32),  # [1]
):
    """Four numbers a thread; whatever thread finds something writes the same."""
    place, start = share_of(ends, wp.tid())
    values = load_quad(tensors[place], start, int(sizes[place]))
    largest = wp.float32(wp.static(LARGEST))
    passes = wp.abs(values[0]) <= largest and wp.abs(values[1]) <= largest
    if not (passes and wp.abs(values[2]) <= largest and wp.abs(values[3]) <= largest):
        if first_bad_step[int(names[place])] == wp.int64(0):
            first_bad_step[int(names[place])] = step[0]
        blocked[0] = 1.0
