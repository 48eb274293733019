"""Noting which of many tensors first held something that is not finite."""

from collections.abc import Sequence

import warp as wp

from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import (
    BLOCK,
    Addresses,
    Counts,
    addresses,
    counts,
    launches,
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


def note_bad(
    tensors: Sequence[wp.array],
    names: Sequence[int],
    step: wp.array,
    first_bad_step: wp.array,
    blocked: wp.array,
) -> None:
    """Looks at tensors, all in the same launch up to PLACES of them.

    Args:
        tensors: float32 [n] each, without gaps and not empty.
        names: place in ``first_bad_step`` of each; several may share one.
        step: int64 [1], the number of the step, at least 1.
        first_bad_step: int64 [names], 0 as long as all was finite; gets the step's number.
        blocked: float32 [1]; gets 1 where something is not finite or beyond LARGEST, and else stays as it is.
    """
    sizes = [len(tensor) for tensor in tensors]
    for some, ends in launches(sizes):
        tables = [counts(ends), counts(sizes[some]), counts(names[some]), addresses(tensors[some])]
        launch_again(note_bad_kernel, ends[-1], [*tables, step, first_bad_step, blocked], step.device, BLOCK)
