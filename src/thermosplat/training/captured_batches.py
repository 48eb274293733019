"""Steps of several frames as CUDA graphs, on one rank or on several, which record and replay them together."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.training.batch_steps import BatchSteps, Plan
from thermosplat.training.captured_steps import CapturedSteps, Readiness, Work
from thermosplat.training.training_step import StepKind, StepValues


class CapturedBatches(CapturedSteps):
    """Runs steps of several frames on CUDA devices, line by line at first and from then on as graphs.

    Exchanges between ranks are part of the graphs, with room for so many rows. So every rank must replay a step, or
    none: before each step the hosts agree on what they do.

    Args:
        batches: The steps, line by line.
        num_frames: Training frames; up to ``MEASURED`` first steps run line by line.
    """

    def __init__(self, batches: BatchSteps, num_frames: int) -> None:
        super().__init__(batches.step, num_frames)
        self.batches, self._team = batches, batches.team

    @contextmanager
    def run(self, frame: FrameTensors, kind: StepKind) -> Iterator[StepValues]:
        """As ``CapturedSteps.run``.

        Args:
            frame: The first of the step's frames; the others are known.
            kind: What is done with them.
        """
        plan = self.batches.plan()
        frames = tuple(self.batches.own_frames(plan, kind))
        with deferred_interrupts():
            yield self._run(frames, kind, plan)

    def _readiness(self, work: Work) -> Readiness:
        own = super()._readiness(work)
        if self._team is None:
            return own
        of_ranks = self._team.numbers([own, len(self._graphs)])
        agreed = Readiness(min(readiness for readiness, _ in of_ranks))
        if agreed is Readiness.CAPTURE and not all(graphs for _, graphs in of_ranks):
            self.forget()  # some rank measures how much room is needed, which all do together
        return agreed

    def _do(self, frames: tuple[FrameTensors, ...], work: Work, *, fixed_capacity: bool) -> StepValues:
        plan = cast("Plan", work.plan)  # a step of several frames has one
        done = self.batches.gradients(plan, frames, work.kind, fixed_capacity=fixed_capacity)
        return self.step.update(work.kind, done)

    def _is_short(self) -> bool:
        short = super()._is_short()
        return short if self._team is None else any(number for (number,) in self._team.numbers([short]))
