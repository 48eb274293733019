"""Work of one call in CUDA graphs: a forward pass in some parts, and any number of backward passes.

The first part ends where it is known whether all (Gaussian, tile) pairs have room. The host reads that while the
others, which sort and blend, still run, so that the device never waits for the host's next launch. Work that is left
out of the graphs, since it has other memory in each replay, is launched between them.
"""

import ctypes
import gc
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
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
        if device.type == "cuda":  # the kernel that notes the pairs writes to the host's memory
            self.overflow = torch.zeros((), dtype=torch.float32, pin_memory=True)
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
    """A forward pass that was recorded, to be done again with what is in the fixed memory."""

    def begin(self) -> None:
        """Does what comes before it is known whether all pairs have room."""

    def go_on(self) -> None:
        """Does the rest."""

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

    def leave_out(self, work: Callable[[], None]) -> None:
        """Called by a body: work that is not recorded, and that each replay does in this place."""


class CudaGraphs:
    """A ``Recorder`` of CUDA graphs, which share one pool of memory and nothing with others."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = capture_stream(device)
        self._pool = torch.cuda.graph_pool_handle()
        self._graph: torch.cuda.CUDAGraph | None = None
        self._parts: list[Callable[[], Any]] = []

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
        """Records a forward pass, in graphs that are cut where it is known whether all pairs have room."""
        flag = _Flag(room.overflow)
        room.after_note = partial(self.leave_out, flag.ask)
        try:
            written, parts = self._recorded(body)
        finally:
            room.after_note = _nothing
        return written, _Forward(parts, flag)

    def backward(self, body: Callable[[], list[Tensor | None]]) -> tuple[list[Tensor | None], Callable[[], None]]:
        """Records a backward pass."""
        written, parts = self._recorded(body)
        return written, partial(_do, parts)

    def leave_out(self, work: Callable[[], None]) -> None:
        """Ends a graph, and begins the next one behind the work."""
        self._end()
        self._parts.append(work)
        self._begin()

    def _recorded(self, body: Callable[[], Found]) -> tuple[Found, list[Callable[[], Any]]]:
        """Records work, and returns what a replay does of it in turn."""
        self._parts = []
        self._begin()
        try:
            result = body()
        except BaseException:
            with suppress(RuntimeError):  # what was wrong is told by the error of the work
                self._end()
            raise
        self._end()
        return result, self._parts

    def _begin(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        # thread_local: other threads may use the device meanwhile
        self._graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")

    def _end(self) -> None:
        graph, self._graph = self._graph, None
        if graph is None:
            return
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            graph.capture_end()
        if not any("Graph is empty" in str(one.message) for one in told):  # as one may be behind what was left out
            self._parts.append(graph.replay)


def _do(parts: Sequence[Callable[[], Any]]) -> None:
    for part in parts:
        part()


class _Flag:
    """Whether all pairs had room. A kernel in the middle of a pass writes it, and it is there before that ends.

    Args:
        overflow: float32 scalar in pinned memory of the host.
    """

    def __init__(self, overflow: Tensor) -> None:
        self._memory = overflow  # kept alive
        self._flag = ctypes.c_float.from_address(overflow.data_ptr())
        self._written = torch.cuda.Event()

    def clear(self) -> None:
        self._flag.value = 0.0

    def ask(self) -> None:
        self._written.record()

    def fits(self) -> bool:
        self._written.synchronize()
        return self._flag.value == 0.0


class _Forward:
    """A forward pass; its flag is asked for after the first part."""

    def __init__(self, parts: Sequence[Callable[[], Any]], flag: _Flag) -> None:
        end = parts.index(flag.ask) + 1
        self.begin, self.go_on = partial(_do, [flag.clear, *parts[:end]]), partial(_do, parts[end:])
        self.fits = flag.fits
