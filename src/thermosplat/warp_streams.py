"""Sharing a device between torch and Warp: one stream, one memory pool, one captured graph."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import warp as wp

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


@contextmanager
def on_torch_stream(device: torch.device) -> Iterator[wp.Device]:
    """Runs Warp on torch's current stream of a device, in torch's memory.

    Args:
        device: a CPU or CUDA device.

    Yields:
        The Warp device.
    """
    wp.init()
    if device.type != "cuda":
        yield wp.device_from_torch(device)
        return
    index = torch.cuda.current_device() if device.index is None else device.index
    stream, allocator = _stream_and_allocator(index, torch.cuda.current_stream(index).cuda_stream)
    with wp.ScopedAllocator(stream.device, allocator), wp.ScopedStream(stream, sync_enter=False):
        yield stream.device


@functools.cache
def _stream_and_allocator(index: int, cuda_stream: int) -> tuple[wp.Stream, TorchAllocator]:
    """Made once for each of torch's streams, which are never destroyed: Warp keeps buffers for a stream it knows."""
    return wp.Stream(wp.get_device(f"cuda:{index}"), cuda_stream=cuda_stream), TorchAllocator(
        torch.device("cuda", index)
    )


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
