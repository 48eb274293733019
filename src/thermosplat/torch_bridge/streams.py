"""Sharing a device between torch and Warp: one stream, one memory pool, one captured graph."""

import functools
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import torch
import warp as wp

from thermosplat.torch_bridge.kernel_cache import cache_error, start_warp
from warp_kernels.machinery.array_views import ArrayView, memory
from warp_kernels.machinery.loading import KernelCacheError, made_once

wp.config.log_level = wp.LOG_WARNING


class TorchAllocator:
    """Makes Warp take its CUDA memory from torch's caching allocator: one pool, also while a graph is captured."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def allocate(self, size_in_bytes: int) -> int:
        """Address of a new block, used on torch's current stream."""
        return torch.cuda.caching_allocator_alloc(size_in_bytes, self.device)

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Give a block back."""
        torch.cuda.caching_allocator_delete(ptr)


class _TensorKinds(dict[Any, tuple[torch.Tensor, tuple[int, ...]]]):
    """By Warp's type of an element, an empty tensor of its scalars and the extents that it adds to a shape."""

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def __missing__(self, dtype: Any) -> tuple[torch.Tensor, tuple[int, ...]]:
        scalar = wp.dtype_to_torch(getattr(dtype, "_wp_scalar_type_", dtype))
        self[dtype] = torch.empty(0, dtype=scalar, device=self._device), getattr(dtype, "_shape_", ())
        return self[dtype]


class TorchMemory:
    """Arrays for the steps of warp_kernels, each on a torch tensor of its own; see ``array_views``.

    Args:
        stream: On CUDA, the stream they are used on.
    """

    def __init__(self, device: torch.device, stream: wp.Stream | None) -> None:
        self.stream = stream
        self._kinds = _TensorKinds(device)

    def empty(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> ArrayView:
        """A new array, not initialised."""
        like, inner = self._kinds[dtype]
        shape = (shape,) if isinstance(shape, int) else shape
        tensor = like.new_empty(*shape, *inner)  # torch reads sizes one by one in two thirds of a tuple's time
        return ArrayView(tensor.data_ptr(), shape, dtype, device, tensor)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> ArrayView:
        """A new array of zeros."""
        like, inner = self._kinds[dtype]
        shape = (shape,) if isinstance(shape, int) else shape
        tensor = like.new_zeros(*shape, *inner)
        return ArrayView(tensor.data_ptr(), shape, dtype, device, tensor)

    def last(self, array: ArrayView) -> Any:
        """The last number, or numbers, of an array made here. Waits for the device."""
        return array.owner[-1].tolist()


class _Place(NamedTuple):
    """Where Warp works for torch: a device and, on CUDA, one of torch's streams."""

    device: wp.Device
    memory: TorchMemory
    allocator: TorchAllocator | None
    turns: AbstractContextManager[Any]
    """Held while Warp's stream and allocator of the device are this place's; Warp has one of each for all threads."""


class _Entered(threading.local):
    """The place of this thread's innermost ``on_torch_stream``."""

    place: _Place | None = None


_entered = _Entered()


class launches_on_torch_stream:
    """Runs the launches of warp_kernels on torch's current stream of a device, with arrays in torch's memory.

    A context that yields the Warp device. It changes nothing of Warp itself, which makes it cheap, and safe where
    other threads render on other streams.
    """

    def __init__(self, device: torch.device) -> None:
        if _is_cuda(device):
            index = torch.cuda.current_device() if device.index is None else device.index
            # as torch.cuda.current_stream(index).cuda_stream, in a tenth of its time
            self._place = _cuda_place(index, torch._C._cuda_getCurrentRawStream(index))
        else:
            self._place = _cpu_place(device)

    def __enter__(self) -> wp.Device:
        self._outer, memory.source = memory.source, self._place.memory
        return self._place.device

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        memory.source = self._outer
        if error is not None and isinstance(error, KernelCacheError):
            raise cache_error(error) from error


class on_torch_stream(launches_on_torch_stream):
    """As ``launches_on_torch_stream``, and Warp's own sorts, scans, launches and allocations.

    Entered again on the same stream it does nothing. Other threads that enter for the same device wait until it is
    left.
    """

    def __enter__(self) -> wp.Device:
        place = self._place
        self._outer_place, _entered.place = _entered.place, place
        self._scopes: tuple[Any, ...] = ()
        if place.memory.stream is not None and self._outer_place is not place:
            self._scopes = (
                place.turns,
                wp.ScopedAllocator(place.device, place.allocator),
                wp.ScopedStream(place.memory.stream, sync_enter=False),
            )
            for scope in self._scopes:
                scope.__enter__()
        self._outer, memory.source = memory.source, place.memory
        return place.device

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        for scope in self._scopes[::-1]:
            scope.__exit__(kind, error, traceback)
        _entered.place = self._outer_place
        super().__exit__(kind, error, traceback)


@functools.cache
def _is_cuda(device: torch.device) -> bool:
    """Whether it is, without the string that torch makes of its kind each time."""
    return device.type == "cuda"


@made_once
def _cpu_place(device: torch.device) -> _Place:
    start_warp()
    return _Place(wp.device_from_torch(device), TorchMemory(device, None), None, nullcontext())


@made_once
def _turns(index: int) -> AbstractContextManager[Any]:
    """One for all streams of a device."""
    return threading.RLock()


@made_once
def _cuda_place(index: int, cuda_stream: int) -> _Place:
    """Made once for each of torch's streams, which are never destroyed: Warp keeps buffers for a stream it knows."""
    start_warp()
    torch_device, device = torch.device("cuda", index), wp.get_device(f"cuda:{index}")
    stream = wp.Stream(device, cuda_stream=cuda_stream)
    return _Place(device, TorchMemory(torch_device, stream), TorchAllocator(torch_device), _turns(index))


_NOT_CAPTURED = nullcontext(False)


def joined_capture(device: torch.device) -> AbstractContextManager[bool]:
    """Around Warp's sorts and scans: where torch captures a CUDA graph, their buffers become the graph's.

    Launches need none of this: on a stream that is captured, they are.

    Args:
        device: Where they run; inside ``on_torch_stream``.

    Returns:
        A context that yields whether a graph is captured.
    """
    if not _is_cuda(device) or not torch.cuda.is_current_stream_capturing():
        return _NOT_CAPTURED
    return _joined_capture(device)


@contextmanager
def _joined_capture(device: torch.device) -> Iterator[bool]:
    warp_device = wp.device_from_torch(device)
    stream = warp_device.stream
    with nullcontext() if stream in warp_device.captures else wp.ScopedCapture(stream=stream, external=True):
        yield True


@functools.cache
def capture_stream(device: torch.device) -> torch.cuda.Stream:
    """Where a device's work is captured; torch would take one stream for all devices, of the first that captures."""
    return torch.cuda.Stream(device)


@contextmanager
def captured_in(graph: torch.cuda.CUDAGraph, pool: Any) -> Iterator[None]:
    """Captures torch's and Warp's work in one CUDA graph instead of doing it.

    Args:
        graph: Empty; holds the work afterwards.
        pool: Memory pool of the graph (the id of a ``torch.cuda.MemPool``).
    """
    device = torch.device("cuda", torch.cuda.current_device())
    # thread_local: other threads (a progress line, a loader) may use the device meanwhile
    captured = torch.cuda.graph(graph, pool=pool, stream=capture_stream(device), capture_error_mode="thread_local")
    with captured, on_torch_stream(device) as warp_device, wp.ScopedCapture(warp_device, external=True):
        yield
