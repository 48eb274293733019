"""Training steps as CUDA graphs: the device's work of a step is recorded once and then replayed by one call.

A step launches some hundreds of small kernels; launching them takes Python longer than running them takes the GPU. A
graph is good as long as the tensors it works on are the same ones: until Gaussians are added or removed, the degree of
the spherical harmonics changes, or frames have another size. Frames are copied into tensors that stay. Where all frames
get another size (``resolution``), or a spectrum a teacher that is rendered too, steps run line by line again for as
long as it takes to see their pairs.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from thermosplat.datasets.frame_tensors import FrameTensors, packed_elsewhere, packed_memory, place_in_frame
from thermosplat.rasterizer.pair_capacity import SPARE
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.torch_bridge.streams import captured_in
from thermosplat.training.training_step import StepKind, StepValues, TrainingStep

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
    cameras: tuple[tuple[bool, str], ...]
    """Whether the lens of each view is a fisheye lens, and in which order its lines are read."""


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
        self._measured_anew = self._to_measure = min(num_frames, MEASURED)
        self._image_factor = 1.0
        self._taught: tuple[str, ...] = ()
        self._seen: set[tuple[_Shape, StepKind]] = set()
        self._frames: dict[_Shape, FrameTensors] = {}
        self._graphs: dict[tuple[_Shape, StepKind], _Captured] = {}
        self._pool = torch.cuda.MemPool()  # outlives the graphs, which take their memory from it one after the other

    @contextmanager
    def run(self, frame: FrameTensors, kind: StepKind) -> Iterator[StepValues]:
        """Do one step; the block goes on with it, and ends before an interrupt is heard.

        The next step overwrites the values.

        Args:
            frame: The frame.
            kind: What is done with it.
        """
        with deferred_interrupts():
            yield self._run(frame, kind)

    def _run(self, frame: FrameTensors, kind: StepKind) -> StepValues:
        if (kind.image_factor, kind.taught) != (self._image_factor, self._taught):
            self._image_factor, self._taught = kind.image_factor, kind.taught
            self._forget_sizes()
        shape = _shape(frame)
        if self._to_measure > 0 or (shape, kind) not in self._seen:
            # also loads kernels, picks algorithms and makes the optimizers' state, none of which can be captured
            self._to_measure -= 1
            self._seen.add((shape, kind))
            return self.step.update(kind, self.step.gradients(frame, kind, fixed_capacity=False))
        if (shape, kind) not in self._graphs:
            self._graphs[shape, kind] = self._capture(frame, shape, kind)
        captured = self._graphs[shape, kind]
        packed_memory(captured.frame).copy_(packed_memory(frame))
        captured.graph.replay()
        self.step.state.step += 1
        return captured.values

    def forget(self, *, kernels: bool = False) -> None:
        """Drop what was captured: the tensors it works on are about to change, or have changed.

        Args:
            kernels: So does what is done with them, and with that the kernels that must be loaded.
        """
        self._graphs.clear()
        if kernels:
            self._seen.clear()

    def _forget_sizes(self) -> None:
        """Other sizes or other scenes are rendered from now on: graphs go, and pairs are counted anew."""
        self.forget()
        self._frames.clear()
        self._to_measure = self._measured_anew

    def check_overflow(self) -> None:
        """See whether all pairs had room; if not, those steps changed nothing, and the next ones get more room."""
        if self._graphs and self.step.capacity.is_short():
            self.forget()

    def _capture(self, frame: FrameTensors, shape: _Shape, kind: StepKind) -> _Captured:
        if shape not in self._frames:
            self._frames[shape] = packed_elsewhere(frame)
        static, graph = self._frames[shape], torch.cuda.CUDAGraph()
        if any(other != kind for _, other in self._graphs):
            self.forget()  # what was done until now is hardly ever done again
        if not self._graphs:
            self.step.capacity.spare = SPARE if kind.densifying else SETTLED_SPARE
            self.step.capacity.measure()
        if self.step.state.noise.device.type == "cuda":
            # each replay then draws from where the step starts it
            graph.register_generator_state(self.step.state.noise)
        done = self.step.state.step
        try:
            with captured_in(graph, self._pool.id):
                values = self.step.update(kind, self.step.gradients(static, kind, fixed_capacity=True))
        finally:
            self.step.state.step = done  # what is captured is not done
        return _Captured(graph, static, values)


def _shape(frame: FrameTensors) -> _Shape:
    tensors = tuple((place_in_frame(frame, tensor), tuple(tensor.shape)) for tensor in frame.packable())
    cameras = tuple((view.fisheye, view.line_order) for view in frame.views.values())
    return _Shape(tensors, len(packed_memory(frame)), frame.shared_cameras, cameras)
