"""Training steps line by line: on the CPU, and on CUDA where steps are not recorded."""

from collections.abc import Iterator
from contextlib import contextmanager

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.training.training_step import Differentiated, StepKind, StepValues, TrainingStep


class PlainSteps:
    """Runs steps as they are; ``CapturedSteps`` has the same methods.

    Args:
        step: The step.
    """

    def __init__(self, step: TrainingStep) -> None:
        self.step = step

    @contextmanager
    def run(self, frame: FrameTensors, kind: StepKind) -> Iterator[StepValues]:
        """Do one step; the block goes on with it, and ends before an interrupt is heard.

        Until the gradients are there, an interrupt ends the step as if it had not begun.

        Args:
            frame: The frame.
            kind: What is done with it.
        """
        differentiated = self._differentiated(frame, kind)
        with deferred_interrupts():  # from here on the step is done as a whole
            yield self.step.update(kind, differentiated)

    def _differentiated(self, frame: FrameTensors, kind: StepKind) -> Differentiated:
        return self.step.gradients(frame, kind, fixed_capacity=False)

    def forget(self, *, kernels: bool = False) -> None:
        """Nothing was recorded that could be forgotten."""

    def check_overflow(self) -> None:
        """Every pair has room: rasterizations read back how many there are."""
