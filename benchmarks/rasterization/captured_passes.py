"""thermosplat's passes in CUDA graphs: captured once a case, replayed where the others are called.

``CapturedPasses`` is a loop that replays whole calls, as the trainer does; ``GraphedPasses`` is code that calls a
function and differentiates what it returns, as any code does; ``torch.cuda.make_graphed_callables`` made the function.

The peers cannot be captured: gsplat and gswarp read counts back to the host within a call, to allocate what they need.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from measuring.gpu_memory import peak_memory
from peers.peer import Rendered, Tensors
from rasterization.passes import Passes, Result
from thermosplat import PairCapacity

SPARE = 1.1
"""Room for pairs over those of the case, which does not change."""

WARM_UP = 2


class CapturedPasses:
    """``Passes`` whose two calls each replay a graph; what they return is overwritten by the next replay.

    Args:
        eager: thermosplat's passes of a case.
        device: a CUDA device, where the case's tensors are; they may change in place.
    """

    def __init__(self, eager: Passes, device: torch.device) -> None:
        self.intersections = eager.intersections
        capacity = _measured(eager, device)
        self._forward, rendered = _captured(eager.forward, capacity)
        self._rendered = Rendered(rendered.images, [])  # the list of pairs in info has the length of the room
        captured: list[tuple[torch.cuda.CUDAGraph, Result]] = []
        self._peak_mib = peak_memory(lambda: captured.append(_captured(eager.forward_backward, capacity)), device)
        self._both, self._result = captured[0]
        self.forward_backward()
        capacity.check()

    def forward(self) -> Rendered:
        """Replays the forward pass."""
        self._forward.replay()
        return self._rendered

    def forward_backward(self) -> Result:
        """Replays forward plus backward."""
        self._both.replay()
        return self._result

    def peak_memory(self, device: torch.device) -> float | None:
        """The most that was allocated while forward plus backward was captured, which the graph keeps [MiB].

        The sorts' own buffers, a few MiB which belong to the graph, are not in it.
        """
        return self._peak_mib


class GraphedPasses(Passes):
    """``Passes`` of a function that torch made of two graphs; what it returns is overwritten by the next call.

    Args:
        eager: thermosplat's passes of a case.
        inputs: the case's tensors, which the graphs read where they lie; they may change in place.
    """

    def __init__(self, eager: Passes, inputs: Tensors) -> None:
        capacity = _measured(eager, inputs["means"].device)
        arguments = tuple(inputs.values())

        def images(*_: Tensor) -> tuple[Tensor, ...]:
            with capacity.step(fixed=True):
                return tuple(eager.render().images)

        function = torch.cuda.make_graphed_callables(images, arguments)
        super().__init__(lambda: Rendered(list(function(*arguments)), []), inputs)
        self.intersections = eager.intersections
        capacity.check()

    def peak_memory(self, device: torch.device) -> float | None:
        """None: the graphs keep what the passes need, and while they are made torch also runs the passes eagerly."""
        return None


def _measured(eager: Passes, device: torch.device) -> PairCapacity:
    """Room for the pairs of a case, whose kernels are loaded by then."""
    capacity, stream = PairCapacity(device, SPARE), torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        for call in (eager.forward, eager.forward_backward) * WARM_UP:
            with capacity.step(fixed=False):
                call()
    torch.cuda.current_stream(device).wait_stream(stream)
    capacity.measure()
    return capacity


def _captured(call: Callable[[], Any], capacity: PairCapacity) -> tuple[torch.cuda.CUDAGraph, Any]:
    """A graph of a call, and what the call returned."""
    graph = torch.cuda.CUDAGraph()
    # The outer context gives the stream back where a capture that failed does not.
    with torch.cuda.stream(torch.cuda.current_stream()), torch.cuda.graph(graph), capacity.step(fixed=True):
        result = call()
    return graph, result
