"""Launching kernels: a recorded launch a kernel, and ranges spread over CPU threads where the device is the CPU.

``wp.launch`` takes thirty microseconds, and a render has ten launches. A ``RecordedLaunch`` keeps what ``wp.launch``
found out about a kernel, and exchanges the arguments' bytes.

Warp runs a CPU launch on one core and releases the GIL meanwhile, so that Python threads on disjoint ranges use the
others. Kernels that are launched over a range take its first index as their first argument and write disjoint memory.
"""

import ctypes
import math
import os
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_kernels.machinery.array_views import ArrayView, memory
from warp_kernels.machinery.loading import first_use

CHUNKS_PER_THREAD = 6
"""Pieces a thread's share is cut into, so that threads finish together although tiles differ in work."""

MIN_CHUNK = 2048
"""Fewest scalar threads worth handing to another core (a hand-over costs about 30 µs)."""

SMALL_BLOCK = 128
"""Threads a block on CUDA where most warps end early: a block keeps its place until its last warp has ended."""

_num_threads = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
_pool: ThreadPoolExecutor | None = None

Dim = int | tuple[int, int]
"""Numbers of threads."""


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


class RecordedLaunch:
    """A launch of a kernel by Warp's recorded launch, whose arguments are exchanged by writing their bytes.

    Args:
        kernel: not generic.
        dim: number of threads.
        inputs: arrays, ints, floats and bools, of the same types at each launch; outputs included. None in the place
            of an array: one without elements. In the place of a struct its fields, one after the other.
        block: threads a block.
    """

    def __init__(self, kernel: wp.Kernel, dim: Dim, inputs: list[Any], device: wp.Device, block: int) -> None:
        command = wp.launch(
            kernel, dim, _as_given(kernel, inputs), device=device, record_tape=False, record_cmd=True, block_dim=block
        )
        command.fwd_args = None  # else the first call's arrays would live as long as the command
        kinds = [type(param) for param in command.params[1:]]
        layout = type("Arguments", (ctypes.Structure,), {"_fields_": [(f"a{k}", kind) for k, kind in enumerate(kinds)]})
        self._bytes = layout()
        formats, end = ["@"], 0
        for k, (kind, argument) in enumerate(zip(kinds, kernel.adj.args[-len(kinds) :], strict=True)):
            offset = getattr(layout, f"a{k}").offset
            for at, field in _fields(kind) if hasattr(argument.type, "native_name") else [(0, kind)]:
                code = getattr(field, "_type_", None)  # a number's; arrays and vectors are bytes
                code = code if isinstance(code, str) else f"{ctypes.sizeof(field)}s"
                formats.append(f"{offset + at - end}x{code}")
                end = offset + at + ctypes.sizeof(field)
            # the command's own parameters, which on CUDA it holds the addresses of, become these bytes
            command.params[k + 1] = kind.from_buffer(self._bytes, offset)
            if command.params_addr:
                command.params_addr[k + 1] = ctypes.addressof(self._bytes) + offset
        self._pack_into = struct.Struct("".join(formats)).pack_into
        self._command, self._dim = command, dim
        # On the CPU, Warp would copy the parameters one by one into a struct of this layout.
        self._run_on_cpu = command.hooks.forward if device.is_cpu and command.block_dim == 1 else None
        self._pointers = ctypes.byref(command.bounds), ctypes.byref(self._bytes)

    def launch(self, dim: Dim, inputs: list[Any]) -> None:
        """Launches with other arguments and another number of threads."""
        if dim != self._dim:
            self._resize(dim)
        packed: list[Any] = []
        for v in inputs:
            kind = type(v)
            if kind is ArrayView:
                packed.append(v.packed)
            else:
                packed.append(v if kind in _NUMBERS else b"" if v is None else _packed(v))
        self._pack_into(self._bytes, 0, *packed)
        if self._run_on_cpu is not None:
            self._run_on_cpu(*self._pointers)
        else:
            self._command.launch(memory.source.stream)

    def _resize(self, dim: Dim) -> None:
        """Another number of threads: what ``set_dim`` of Warp's does, in a tenth of its time where nothing is large."""
        extents = (dim,) if isinstance(dim, int) else dim
        bounds, threads = self._command.bounds, math.prod(extents)
        if len(extents) == len(bounds.shape) and threads < 2**31:
            bounds.shape[:] = extents
            bounds.size = threads
        else:
            self._command.set_dim(dim)
            self._pointers = ctypes.byref(self._command.bounds), self._pointers[1]
        self._dim = dim


def _as_given(kernel: wp.Kernel, inputs: list[Any]) -> list[Any]:
    """A kernel's arguments as ``wp.launch`` takes them."""
    left = iter([value.array() if type(value) is ArrayView else value for value in inputs])
    given = []
    for argument in kernel.adj.args:
        if not hasattr(argument.type, "native_name"):
            given.append(next(left))
            continue
        instance = argument.type()
        for name in argument.type.vars:
            value = next(left)
            if value is not None:
                setattr(instance, name, value)
        given.append(instance)
    return given


def _fields(kind: Any) -> list[tuple[int, Any]]:
    """Place [bytes] and type of each field of a struct."""
    return [(getattr(kind, name).offset, field) for name, field in kind._fields_]


_NUMBERS = frozenset((int, float, bool))


def _packed(value: Any) -> Any:
    """Any other argument as ``struct`` packs it: a number, or the bytes of an array, a struct or a vector."""
    if isinstance(value, (int, float)):
        return value
    if hasattr(value, "__ctype__"):
        return bytes(value.__ctype__())
    return value.value if hasattr(value, "value") else bytes(value)  # a Warp scalar, or a vector


class _Recorded(threading.local):
    """Recorded launches of this thread, whose arguments no other thread may exchange before the launch."""

    def __init__(self) -> None:
        self.by_kernel: dict[tuple[wp.Kernel, str, int | None], RecordedLaunch] = {}


_recorded = _Recorded()


def launch_again(kernel: wp.Kernel, dim: Dim, inputs: list[Any], device: wp.Device, block: int | None = None) -> None:
    """Launches a kernel without recording it on a tape, checking the arguments' types the first time only.

    Args:
        inputs: arrays, ints, floats and bools, of the same types at each call; outputs included. None in the place of
            an array: one without elements.
        block: threads a block; None for Warp's default.
    """
    if dim == 0:
        return
    key = (kernel, device.alias, block)
    recorded = _recorded.by_kernel.get(key)
    if recorded is None:
        with first_use(kernel, device, block or 256):
            recorded = _recorded.by_kernel[key] = RecordedLaunch(kernel, dim, inputs, device, block or 256)
    recorded.launch(dim, inputs)


def launch(
    kernel: wp.Kernel,
    count: int,
    inputs: list[Any],
    device: wp.Device,
    block: int | None = None,
    chunk: int = MIN_CHUNK,
) -> None:
    """Launches ``kernel`` once per index, without recording it on a tape.

    Args:
        kernel: its first argument is the first index of the range; ``inputs`` are the others, outputs included.
        block: threads a block on CUDA; None for Warp's default.
        chunk: indices that a CPU's thread takes at least.
    """
    on_cpu = device.alias == "cpu"
    if on_cpu and count >= 2 * chunk and _num_threads > 1:
        _spread(kernel, count, count // chunk, None, inputs, device)
    else:
        launch_again(kernel, count, [0, *inputs], device, None if on_cpu else block)


def launch_tiles(kernel: wp.Kernel, num_tiles: int, threads: int, inputs: list[Any], device: wp.Device) -> None:
    """Launches a blending kernel, one block of ``threads`` threads a tile, without recording it on a tape.

    Args:
        kernel: its first argument is the first tile of the range; ``inputs`` are the others, outputs included.
    """
    if num_tiles == 0:
        return
    if num_tiles == 1 or _num_threads == 1 or device.alias != "cpu":
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
