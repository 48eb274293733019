"""Training steps as CUDA graphs: the device's work of a step is recorded once and then replayed by one call.

A step launches some hundreds of small kernels; launching them takes Python longer than running them takes the GPU. A
graph is good as long as the tensors it works on are the same ones: until Gaussians are added or removed, the degree of
the spherical harmonics changes, or frames have another size. Frames are copied into tensors that stay.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.pair_capacity import SPARE
from thermosplat.training.training_step import StepKind, StepValues, TrainingStep
from thermosplat.warp_streams import captured_in

LARGE = 4096
"""Numbers of a tensor from which a copy of its own is quicker than a share in one kernel for all, which has few blocks
of threads."""

MEASURED = 16
"""Steps that run line by line at first, to see how many pairs frames have."""

SETTLED_SPARE = 1.15
"""Room for pairs, over the most that were seen, once no Gaussians are added; what is not used is sorted too."""


@dataclass(frozen=True)
class _Shape:
    """What two frames must share to be the same work."""

    rgb: tuple[tuple[int, ...] | None, ...]
    thermal: tuple[tuple[int, ...] | None, ...]
    aligned: bool


@dataclass(frozen=True)
class _Captured:
    """A recorded step."""

    graph: torch.cuda.CUDAGraph
    frame: FrameTensors
    values: StepValues


class CapturedSteps:
    """Runs steps on a CUDA device, each kind of step once line by line and from then on as a graph.

    Args:
        step: The step.
        num_frames: Training frames; up to ``MEASURED`` first steps run line by line.
    """

    def __init__(self, step: TrainingStep, num_frames: int) -> None:
        self.step = step
        self._to_measure = min(num_frames, MEASURED)
        self._seen: set[tuple[_Shape, StepKind]] = set()
        self._frames: dict[_Shape, FrameTensors] = {}
        self._graphs: dict[tuple[_Shape, StepKind], _Captured] = {}
        self._pool = torch.cuda.MemPool()  # outlives the graphs, which take their memory from it one after the other

    def run(self, frame: FrameTensors, kind: StepKind) -> StepValues:
        """Do one step.

        Args:
            frame: The frame.
            kind: What is done with it.

        Returns:
            The step's values; the next step overwrites them.
        """
        shape = _shape(frame)
        if self._to_measure > 0 or (shape, kind) not in self._seen:
            # also loads kernels, picks algorithms and makes the optimizers' state, none of which can be captured
            self._to_measure -= 1
            self._seen.add((shape, kind))
            return self.step.update(frame, kind, self.step.gradients(frame, kind, fixed_capacity=False))
        if (shape, kind) not in self._graphs:
            self._graphs[shape, kind] = self._capture(frame, shape, kind)
        captured = self._graphs[shape, kind]
        _copy(captured.frame, frame)
        captured.graph.replay()
        return captured.values

    def forget(self) -> None:
        """Drop what was captured: the tensors it works on are about to change, or have changed."""
        self._graphs.clear()

    def look(self) -> None:
        """See whether all pairs had room; if not, those steps changed nothing, and the next ones get more room."""
        if self._graphs and self.step.capacity.is_short():
            self.forget()

    def _capture(self, frame: FrameTensors, shape: _Shape, kind: StepKind) -> _Captured:
        if shape not in self._frames:
            self._frames[shape] = _clone(frame)
        static, graph = self._frames[shape], torch.cuda.CUDAGraph()
        if not self._graphs:
            self.step.capacity.spare = SPARE if kind.densifying else SETTLED_SPARE
            self.step.capacity.measure()
        if self.step.state.noise.device.type == "cuda":
            # each replay then draws from where the step starts it
            graph.register_generator_state(self.step.state.noise)
        with captured_in(graph, self._pool.id):
            values = self.step.update(static, kind, self.step.gradients(static, kind, fixed_capacity=True))
        return _Captured(graph, static, values)


def _tensors(view: ViewTensors | None) -> list[Tensor | None]:
    return [] if view is None else [view.viewmat, view.K, view.image, view.intensity]


def _shape(frame: FrameTensors) -> _Shape:
    rgb, thermal = (
        tuple(None if tensor is None else tuple(tensor.shape) for tensor in _tensors(view))
        for view in (frame.rgb, frame.thermal)
    )
    return _Shape(rgb, thermal, frame.aligned)


def _clone(frame: FrameTensors) -> FrameTensors:
    def cloned(view: ViewTensors | None) -> ViewTensors | None:
        if view is None:
            return None
        image, intensity = (None if tensor is None else tensor.clone() for tensor in (view.image, view.intensity))
        return ViewTensors(view.viewmat.clone(), view.K.clone(), view.width, view.height, image, intensity)

    index = None if frame.index is None else frame.index.clone()
    return FrameTensors(frame.name, cloned(frame.rgb), cloned(frame.thermal), frame.aligned, index)


def _copy(target: FrameTensors, source: FrameTensors) -> None:
    if target.index is not None and source.index is not None:
        target.index.copy_(source.index)
    to: list[Tensor] = []
    values: list[Tensor] = []
    for ours, theirs in ((target.rgb, source.rgb), (target.thermal, source.thermal)):
        for tensor, value in zip(_tensors(ours), _tensors(theirs), strict=True):
            if tensor is None or value is None:
                continue
            if tensor.numel() > LARGE:
                tensor.copy_(value)
            else:
                to.append(tensor)
                values.append(value)
    torch._foreach_copy_(to, values)
