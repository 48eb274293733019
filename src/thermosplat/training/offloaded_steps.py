"""Training steps with moments on the device that go to the host's memory where a step needs the room."""

from collections.abc import Callable

import torch

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.training.plain_steps import PlainSteps
from thermosplat.training.session.out_of_memory import is_out_of_memory
from thermosplat.training.training_step import Differentiated, StepKind, TrainingStep


class OffloadedSteps(PlainSteps):
    """Steps that begin again with fewer moments on the device when its memory runs out.

    How much a step needs depends on how many Gaussians its camera sees. Until the gradients are there, nothing of the
    training's state has changed.

    Args:
        step: The step.
        say: Tells the user something.
    """

    def __init__(self, step: TrainingStep, say: Callable[[str], None]) -> None:
        super().__init__(step)
        self._say = say

    def _differentiated(self, frame: FrameTensors, kind: StepKind) -> Differentiated:
        while True:
            try:
                return super()._differentiated(frame, kind)
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error) or not self._leave_more_room():
                    raise
            # Here, where the error no longer holds what the step had made
            self.step.state.clear_gradients()
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _leave_more_room(self) -> bool:
        state = self.step.state
        optimizers = [optimizer for name in state.gaussian_sets for optimizer in state.row_optimizers(name)]
        if not any([optimizer.leave_more_room() for optimizer in optimizers]):  # a list: each of them does
            return False
        rows = max(optimizer.rows_on_device for optimizer in optimizers)
        self._say(
            "The GPU's memory ran out. Moments of harmonics and features stay on it for "
            f"{f'{rows:,} Gaussians' if rows else 'no Gaussian'} from now on; steps may take longer."
        )
        return True
