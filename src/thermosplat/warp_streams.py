"""Sharing a device between torch and Warp: one stream, one memory pool, one captured graph."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

import torch
import warp as wp

from warp_kernels.array_views import ArrayView, memory

wp.config.log_level = wp.LOG_WARNING


class TorchAllocator:
    """Makes Warp take its CUDA memory from torch's caching allocator: one pool, also while a graph is captured.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def allocate(self, size_in_bytes: int) -> int:
        """Address of a new block, used on torch's current stream."""
        return torch.cuda.caching_allocator_alloc(size_in_bytes, self.device)

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Give a block back."""
        torch.cuda.caching_allocator_delete(ptr)


class TorchMemory:
    """Arrays for the steps of warp_kernels, each on a torch tensor of its own; see ``warp_kernels.array_views``.

    Args:
        device: Torch's name of the device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def empty(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> ArrayView:
        """A new array, not initialised."""
        return self._array(torch.empty, shape, dtype, device)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> ArrayView:
        """A new array of zeros."""
        return self._array(torch.zeros, shape, dtype, device)

    def _array(self, make: Any, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> ArrayView:
        scalar, inner = _scalar_and_shape(dtype)
        shape = (shape,) if isinstance(shape, int) else shape
        tensor = make(shape + inner, dtype=scalar, device=self.device)
        return ArrayView(tensor.data_ptr(), shape, dtype, device, tensor)

    def fill(self, array: ArrayView, count: int, value: int) -> None:
        """Sets the first ``count`` numbers of an array made here."""
        array.owner[:count].fill_(value)

    def last(self, array: ArrayView) -> Any:
        """The last number, or numbers, of an array made here. Waits for the device."""
        return array.owner[-1].tolist()


@functools.cache
def _scalar_and_shape(dtype: Any) -> tuple[torch.dtype, tuple[int, ...]]:
    """Torch's type for the numbers of a Warp type, and the shape of one element."""
    return wp.dtype_to_torch(getattr(dtype, "_wp_scalar_type_", dtype)), getattr(dtype, "_shape_", ())


class _Place(NamedTuple):
    """Where Warp works for torch: a device and, on CUDA, one of torch's streams."""

    device: wp.Device
    memory: TorchMemory
    stream: wp.Stream | None
    allocator: TorchAllocator | None


class on_torch_stream:
    """Runs Warp on torch's current stream of a device, in torch's memory; a context that yields the Warp device.

    Entered again on the same stream it does nothing, so that a render may hold it around its steps.

    Args:
        device: a CPU or CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        if device.type == "cuda":
            index = torch.cuda.current_device() if device.index is None else device.index
            self._place = _cuda_place(index, torch.cuda.current_stream(index).cuda_stream)
        else:
            self._place = _cpu_place(device)

    def __enter__(self) -> wp.Device:
        place, self._outer = self._place, memory.source
        if self._outer is not place.memory:
            memory.source = place.memory
            if place.stream is not None:
                self._scopes = (
                    wp.ScopedAllocator(place.device, place.allocator),
                    wp.ScopedStream(place.stream, sync_enter=False),
                )
                for scope in self._scopes:
                    scope.__enter__()
        return place.device

    def __exit__(self, *exception: Any) -> None:
        if self._outer is not self._place.memory:
            memory.source = self._outer
            if self._place.stream is not None:
                for scope in reversed(self._scopes):
                    scope.__exit__(*exception)


@functools.cache
def _cpu_place(device: torch.device) -> _Place:
    wp.init()
    return _Place(wp.device_from_torch(device), TorchMemory(device), None, None)


@functools.cache
def _cuda_place(index: int, cuda_stream: int) -> _Place:
    """Made once for each of torch's streams, which are never destroyed: Warp keeps buffers for a stream it knows."""
    wp.init()
    torch_device, device = torch.device("cuda", index), wp.get_device(f"cuda:{index}")
    stream = wp.Stream(device, cuda_stream=cuda_stream)
    return _Place(device, TorchMemory(torch_device), stream, TorchAllocator(torch_device))


@contextmanager
def joined_capture(device: torch.device) -> Iterator[bool]:
    """Around Warp's sorts and scans: where torch captures a CUDA graph, their buffers become the graph's.

    Launches need none of this: on a stream that is captured, they are.

    Args:
        device: Where they run; inside ``on_torch_stream``.

    Yields:
        Whether a graph is captured.
    """
    if device.type != "cuda" or not torch.cuda.is_current_stream_capturing():
        yield False
        return
    warp_device = wp.device_from_torch(device)
    stream = warp_device.stream
    with nullcontext() if stream in warp_device.captures else wp.ScopedCapture(stream=stream, external=True):
        yield True


@contextmanager
def captured_in(graph: torch.cuda.CUDAGraph, pool: Any) -> Iterator[None]:
    """Captures torch's and Warp's work in one CUDA graph instead of doing it.

    Args:
        graph: Empty; holds the work afterwards.
        pool: Memory pool of the graph (the id of a ``torch.cuda.MemPool``).
    """
    # thread_local: other threads (a progress line, a loader) may use the device meanwhile
    with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
        device = torch.device("cuda", torch.cuda.current_device())
        with on_torch_stream(device) as warp_device, wp.ScopedCapture(warp_device, external=True):
            yield
