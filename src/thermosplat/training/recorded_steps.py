"""Training steps as CUDA graphs: the device's work of a step is recorded once and then replayed by one call.

A step launches some hundreds of small kernels; launching them takes Python longer than running them takes the GPU. A
graph is good as long as the tensors it works on are the same ones: until Gaussians are added or removed, the degree of
the spherical harmonics changes, or frames have another size. Frames are copied into tensors that stay. Where all frames
get another size (``resolution``), or a spectrum a teacher that is rendered too, steps run line by line again for as
long as it takes to see their pairs.

Exchanges between ranks are part of the graphs, with room for so many rows. So every rank must replay a step, or none:
before each step the hosts agree on what they do.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch

from thermosplat.datasets.frame_tensors import FrameTensors, packed_elsewhere, packed_memory, place_in_frame
from thermosplat.rasterizer.pair_capacity import SPARE
from thermosplat.torch_bridge.streams import captured_in
from thermosplat.training.step_kind import Plan, StepKind, StepValues
from thermosplat.training.training_step import TrainingStep

MEASURED = 16
"""Steps that run line by line at first, to see how many pairs frames have."""

SETTLED_SPARE = 1.15
"""Room for pairs, over the most that were seen, once no Gaussians are added; what is not used is sorted too."""


@dataclass(frozen=True)
class _Shape:
    """What two frames must share to be the same work."""

    tensors: tuple[tuple[int, tuple[int, ...]], ...]
    """Where they lie, and their shapes."""
    numbers: int
    """Of all the memory."""
    shared_cameras: tuple[tuple[str, ...], ...]
    """The spectra, in groups of one camera."""
    kinds: tuple[tuple[str, str, bool], ...]
    """Which model the lens of each view has, in which order its lines are read, and whether it has a mask."""


@dataclass(frozen=True)
class Captured:
    """A recorded step."""

    graph: torch.cuda.CUDAGraph
    frames: tuple[FrameTensors, ...]
    values: StepValues


class Work(NamedTuple):
    """What two steps must share to be recorded once."""

    shapes: tuple[_Shape | None, ...]
    """Of the frames; None of one without a view."""
    plan: Plan
    """The frames of all ranks."""
    kind: StepKind


class Readiness(IntEnum):
    """What can be done with a step."""

    LINE_BY_LINE = 0
    CAPTURE = 1
    REPLAY = 2


class RecordedSteps:
    """Runs steps on a CUDA device, each kind of step once line by line and from then on as a graph.

    Args:
        num_frames: Training frames; up to ``MEASURED`` first steps run line by line.

    Attributes:
        graphs: What was captured.
    """

    def __init__(self, step: TrainingStep, num_frames: int) -> None:
        self.step = step
        self._measured_anew = self._to_measure = min(num_frames, MEASURED)
        self._image_factor = 1.0
        self._taught: tuple[str, ...] = ()
        self._seen: set[Work] = set()
        self.frames: dict[tuple[_Shape | None, ...], tuple[FrameTensors, ...]] = {}
        self.graphs: dict[Work, Captured] = {}
        self._pool = torch.cuda.MemPool()  # outlives the graphs, which take their memory from it one after the other

    def run(self, frames: tuple[FrameTensors, ...], plan: Plan, kind: StepKind) -> StepValues:
        """Do one step; the next one overwrites the values."""
        if (kind.image_factor, kind.taught) != (self._image_factor, self._taught):
            self._image_factor, self._taught = kind.image_factor, kind.taught
            self._forget_sizes()
        work = Work(tuple(map(frame_shape, frames)), plan, kind)
        readiness = self._readiness(work)
        if readiness is Readiness.LINE_BY_LINE:
            # also loads kernels, picks algorithms and makes the optimizers' state, none of which can be captured
            self._to_measure -= 1
            self._seen.add(work)
            return self._do(frames, work, fixed_capacity=False)
        if readiness is Readiness.CAPTURE:
            self.graphs[work] = self._capture(frames, work)
        captured = self.graphs[work]
        for static, frame in zip(captured.frames, frames, strict=True):
            if frame.views:
                packed_memory(static).copy_(packed_memory(frame))
        captured.graph.replay()
        self.step.state.step += 1
        return captured.values

    def _readiness(self, work: Work) -> Readiness:
        """What all ranks do with a step."""
        own, team = self._own_readiness(work), self.step.team
        of_ranks = team.numbers([own, len(self.graphs)])
        agreed = Readiness(min(readiness for readiness, _ in of_ranks))
        if agreed is Readiness.CAPTURE and not all(graphs for _, graphs in of_ranks):
            self.forget()  # some rank measures how much room is needed, which all do together
        return agreed

    def _own_readiness(self, work: Work) -> Readiness:
        if self._to_measure > 0 or work not in self._seen:
            return Readiness.LINE_BY_LINE
        if work in self.graphs:
            return Readiness.REPLAY
        if any(other.kind != work.kind for other in self.graphs):
            self.forget()  # what was done until now is hardly ever done again
        return Readiness.CAPTURE

    def _do(self, frames: tuple[FrameTensors, ...], work: Work, *, fixed_capacity: bool) -> StepValues:
        """The step itself."""
        done = self.step.gradients(frames, work.kind, work.plan, fixed_capacity=fixed_capacity)
        return self.step.update(work.kind, done)

    def forget(self, *, kernels: bool = False) -> None:
        """As ``Steps.forget``."""
        self.graphs.clear()
        if kernels:
            self._seen.clear()

    def _forget_sizes(self) -> None:
        """Other sizes or other scenes are rendered from now on: graphs go, and pairs are counted anew."""
        self.forget()
        self.frames.clear()
        self._to_measure = self._measured_anew

    def check_overflow(self) -> None:
        """As ``Steps.check_overflow``."""
        short = bool(self.graphs) and self.step.capacity.is_short()
        if any(number for (number,) in self.step.team.numbers([short])):
            self.forget()

    def _capture(self, frames: tuple[FrameTensors, ...], work: Work) -> Captured:
        if work.shapes not in self.frames:
            self.frames[work.shapes] = tuple(packed_elsewhere(frame) if frame.views else frame for frame in frames)
        static, graph = self.frames[work.shapes], torch.cuda.CUDAGraph()
        if not self.graphs:
            self.step.capacity.spare = SPARE if work.kind.densifying else SETTLED_SPARE
            self.step.capacity.measure()
        if self.step.state.noise.device.type == "cuda":
            # each replay then draws from where the step starts it
            graph.register_generator_state(self.step.state.noise)
        done = self.step.state.step
        try:
            with captured_in(graph, self._pool.id):
                values = self._do(static, work, fixed_capacity=True)
        finally:
            self.step.state.step = done  # what is captured is not done
        return Captured(graph, static, values)


def frame_shape(frame: FrameTensors) -> _Shape | None:
    """What frames that one recording serves have in common; None: there is nothing to train on."""
    if not frame.views:
        return None
    tensors = tuple((place_in_frame(frame, tensor), tuple(tensor.shape)) for tensor in frame.packable())
    kinds = tuple((view.lens_model, view.line_order, view.mask is not None) for view in frame.views.values())
    return _Shape(tensors, len(packed_memory(frame)), frame.shared_cameras, kinds)
