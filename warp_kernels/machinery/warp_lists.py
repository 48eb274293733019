"""Lists of whole numbers that the lanes of a warp share, in shared memory. CUDA only.

What few of many threads have to do keeps whole warps busy otherwise: lanes that would wait for their neighbours. So a
warp first lists what is to be done, and then each lane takes an item.
"""

from typing import Any

import warp as wp

from warp_kernels.machinery.lanes import LANES_CUDA, count_bits, on_cuda, warp_ballot
from warp_kernels.machinery.loading import made_once

WARPS = 8
"""Of a block of Warp's default size."""

EACH = 4
"""Candidates that a lane looks at where few of them are worth more. Their numbers are asked for at once, ..."""

MANY = EACH * LANES_CUDA
"""... those of so many candidates by a warp."""

LISTED = 2**20
"""Gaussians above which a warp looks at ``MANY``: of so many few are visible."""


def threads_of_many(count: int) -> int:
    """Threads to launch for so many candidates: a warp for each ``MANY``."""
    return -(-count // MANY) * LANES_CUDA


@made_once
def list_functions(warps: int, capacity: int) -> tuple[Any, Any, Any]:
    """A list for each warp of a block of threads.

    Args:
        capacity: items of a list at a time, a power of two; item ``capacity`` takes the place of item 0.

    Returns:
        Warp functions ``(list_of_warp, append, item)``: the address of a warp's list; append the values of those lanes
        that want it, in the lanes' order, and count; read one. All lanes append together; between appending and reading
        there must be a ``warp_sync``.
    """
    buffer = f"__shared__ int lists[{warps * capacity}];"
    place = f"((int*)address)[at & {capacity - 1}]"

    @wp.func_native(on_cuda(f"{buffer}\nreturn (wp::uint64)(lists + warp * {capacity});", "return 0;"))
    def list_of_warp(warp: int) -> wp.uint64: ...

    @wp.func_native(on_cuda(f"{place} = value;"))
    def put(address: wp.uint64, at: int, value: int): ...

    @wp.func_native(on_cuda(f"return {place};", "return 0;"))
    def item(address: wp.uint64, at: int) -> int: ...

    @wp.func
    def append(address: wp.uint64, count: int, lane: int, wanted: bool, value: int):
        takers = warp_ballot(wp.where(wanted, 1, 0))
        if wanted:
            before = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
            put(address, count + count_bits(takers & before), value)
        return count + count_bits(takers)

    return list_of_warp, append, item
