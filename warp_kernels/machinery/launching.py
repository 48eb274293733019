"""Launching a kernel over a range, spread over CPU threads where the device is the CPU.

Warp runs a CPU launch on one core and releases the GIL meanwhile, so that Python threads on disjoint ranges use the
others. Kernels launched here take the range's first index as their first argument and write disjoint memory.
"""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_kernels.machinery.array_views import RecordedLaunch
from warp_kernels.machinery.loading import first_use

CHUNKS_PER_THREAD = 6
"""Pieces a thread's share is cut into, so that threads finish together although tiles differ in work."""

MIN_CHUNK = 2048
"""Fewest scalar threads worth handing to another core (a hand-over costs about 30 µs)."""

SMALL_BLOCK = 128
"""Threads a block on CUDA where most warps end early: a block keeps its place until its last warp has ended."""

_num_threads = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
_pool: ThreadPoolExecutor | None = None


def num_threads() -> int:
    """CPU threads that launches are spread over."""
    return _num_threads


def set_num_threads(count: int) -> None:
    """Sets the CPU threads that launches are spread over; results do not depend on it.

    Args:
        count: at least 1. The default is the number of cores this process may use.

    Raises:
        ValueError: if ``count`` is below 1.
    """
    global _num_threads, _pool
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}.")
    if count != _num_threads and _pool is not None:
        _pool.shutdown()
        _pool = None
    _num_threads = count


def launch(kernel: wp.Kernel, count: int, inputs: list[Any], device: wp.Device, block: int | None = None) -> None:
    """Launches ``kernel`` once per index, without recording it on a tape.

    Args:
        kernel: its first argument is the first index of the range; ``inputs`` are the others, outputs included.
        count: number of indices.
        inputs: arguments after the first.
        device: where to run.
        block: threads a block on CUDA; None for Warp's default.
    """
    if count < 2 * MIN_CHUNK or _num_threads == 1 or device.is_cuda:
        launch_again(kernel, count, [0, *inputs], device, block if device.is_cuda else None)
    else:
        _spread(kernel, count, count // MIN_CHUNK, None, inputs, device)


def launch_again(
    kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list[Any], device: wp.Device, block: int | None = None
) -> None:
    """Launches a kernel without recording it on a tape, checking the arguments' types the first time only.

    Args:
        kernel: not generic.
        dim: number of threads.
        inputs: arrays, ints, floats and bools, of the same types at each call; outputs included. None in the place of
            an array: one without elements.
        device: where to run.
        block: threads a block; None for Warp's default.
    """
    if dim == 0:
        return
    key = (kernel, device.alias, block)
    try:
        recorded = _recorded.by_kernel[key]
    except KeyError:
        with first_use(kernel, device, block or 256):
            recorded = _recorded.by_kernel[key] = RecordedLaunch(kernel, dim, inputs, device, block or 256)
    recorded.launch(dim, inputs)


class _Recorded(threading.local):
    """Recorded launches of this thread, whose arguments no other thread may exchange before the launch."""

    def __init__(self) -> None:
        self.by_kernel: dict[tuple[wp.Kernel, str, int | None], RecordedLaunch] = {}


_recorded = _Recorded()


def launch_tiles(kernel: wp.Kernel, num_tiles: int, threads: int, inputs: list[Any], device: wp.Device) -> None:
    """Launches a blending kernel, one block of ``threads`` threads a tile, without recording it on a tape.

    Args:
        kernel: its first argument is the first tile of the range; ``inputs`` are the others, outputs included.
        num_tiles: number of tiles.
        threads: threads a tile.
        inputs: arguments after the first.
        device: where to run.
    """
    if num_tiles == 0:
        return
    if num_tiles == 1 or _num_threads == 1 or device.is_cuda:
        launch_again(kernel, (num_tiles, threads), [0, *inputs], device, threads)
    else:
        _spread(kernel, num_tiles, num_tiles, threads, inputs, device)


def _spread(kernel: wp.Kernel, count: int, most: int, block: int | None, inputs: list[Any], device: wp.Device) -> None:
    """Launches a range in at most so many pieces, spread over CPU threads."""

    def run(first: int, end: int) -> None:
        dim = end - first if block is None else (end - first, block)
        launch_again(kernel, dim, [first, *inputs], device, block)

    chunks = min(most, _num_threads * CHUNKS_PER_THREAD)
    bounds = [count * k // chunks for k in range(chunks + 1)]
    # Consume the iterator: an exception in a thread is raised here.
    list(_threads().map(run, bounds[:-1], bounds[1:]))


def _threads() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(_num_threads, thread_name_prefix="warp_kernels")
    return _pool


def _forget_threads() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_forget_threads)  # threads stay with the parent: their pool would wait forever
