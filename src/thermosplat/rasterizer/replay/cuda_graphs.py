"""Work of one call in CUDA graphs: a forward pass in two parts, and any number of backward passes.

The first part ends where it is known whether all (Gaussian, tile) pairs have room. The host reads that while the second
part, which sorts nothing and blends, still runs, so that the device never waits for the host's next launch.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.torch_bridge.streams import capture_stream

Found = TypeVar("Found")


class RoomForOne(PairCapacity):
    """The room of one rasterization, which says when it has noted whether the pairs fit.

    Args:
        device: Where the renderer runs.
        most: Pairs, and Gaussians with pairs, that were seen at most.
        spare: Room over them, as a factor.
    """

    def __init__(self, device: torch.device, most: tuple[int, int], spare: float) -> None:
        super().__init__(device, spare)
        self.most[0], self.most_listed[0] = most
        self.measure()
        self.after_note: Callable[[], None] = _nothing

    def note(self, totals: Tensor) -> None:
        """As ``PairCapacity.note``; afterwards it is known on the device whether the pairs fit."""
        super().note(totals)
        self.after_note()


def _nothing() -> None:
    pass


class ForwardPass(Protocol):
    """A forward pass that was recorded."""

    def replay(self) -> None:
        """Does it again, with what is in the fixed memory."""

    def fits(self) -> bool:
        """Whether all pairs of the last replay had room."""


class Recorder(Protocol):
    """Records work to be done again."""

    def recording(self) -> Any:
        """A context around everything that is recorded of one call."""

    def forward(self, body: Callable[[], list[Tensor]], room: RoomForOne) -> tuple[list[Tensor], ForwardPass]:
        """Records a forward pass; returns the tensors that it and its replays write."""

    def backward(self, body: Callable[[], list[Tensor | None]]) -> tuple[list[Tensor | None], Callable[[], None]]:
        """Records a backward pass; returns the tensors that it and its replays write, and the replay."""


class CudaGraphs:
    """A ``Recorder`` of CUDA graphs, which share one pool of memory and nothing with others.

    Args:
        device: A CUDA device, the current one.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = capture_stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    @contextmanager
    def recording(self) -> Iterator[None]:
        """On a stream of its own, on which nothing is captured yet; nothing else is queued on the device."""
        collecting = gc.isenabled()
        gc.disable()  # what is collected while a graph is captured may be another graph, or an event
        try:
            torch.cuda.synchronize(self._device)
            with torch.cuda.stream(self._stream):
                yield
            torch.cuda.synchronize(self._device)
        finally:
            if collecting:
                gc.enable()

    def forward(self, body: Callable[[], list[Tensor]], room: RoomForOne) -> tuple[list[Tensor], ForwardPass]:
        """Records a forward pass in two graphs."""
        first, second = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        capturing = [first]

        def part() -> None:
            capturing.pop().capture_end()
            self._begin(second)
            capturing.append(second)

        self._begin(first)
        room.after_note = part
        try:
            written = body()
        except BaseException:
            _abandon(capturing)
            raise
        finally:
            room.after_note = _nothing
        capturing.pop().capture_end()
        return written, _TwoGraphs(first, second, room.overflow)

    def backward(self, body: Callable[[], list[Tensor | None]]) -> tuple[list[Tensor | None], Callable[[], None]]:
        """Records a backward pass in one graph."""
        graph = torch.cuda.CUDAGraph()
        self._begin(graph)
        try:
            written = body()
        except BaseException:
            _abandon([graph])
            raise
        graph.capture_end()
        return written, graph.replay

    def _begin(self, graph: torch.cuda.CUDAGraph) -> None:
        # thread_local: other threads may use the device meanwhile
        graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")


def _abandon(capturing: list[torch.cuda.CUDAGraph]) -> None:
    """Ends a capture whose work failed; what was wrong is told by the error of that."""
    for graph in capturing:
        with suppress(RuntimeError):
            graph.capture_end()


class _TwoGraphs:
    """A forward pass. The flag is copied to the host between its parts, and is there before the second has ended."""

    def __init__(self, first: torch.cuda.CUDAGraph, second: torch.cuda.CUDAGraph, overflow: Tensor) -> None:
        self._first, self._second, self._overflow = first.replay, second.replay, overflow
        self._flag = torch.zeros((), dtype=torch.float32, device="cpu", pin_memory=True)
        self._read = torch.cuda.Event()

    def replay(self) -> None:
        self._first()
        self._flag.copy_(self._overflow, non_blocking=True)
        self._read.record()
        self._second()

    def fits(self) -> bool:
        self._read.synchronize()
        return self._flag.item() == 0
