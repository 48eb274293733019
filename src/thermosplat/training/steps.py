"""The training steps of a run: of one frame or several, plain or recorded.

A step's loss is the mean over its frames. Frame k of a step is rendered by rank k mod W, W frames at a time.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from thermosplat.config import OF_FRAMES
from thermosplat.config.run_schedule import adam_betas
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.training.frames.train_frames import SpectrumSchedule, TrainFrames
from thermosplat.training.optimizers import set_betas
from thermosplat.training.out_of_memory import is_out_of_memory
from thermosplat.training.recorded_steps import RecordedSteps
from thermosplat.training.step_kind import Group, Plan, StepKind, StepValues
from thermosplat.training.training_step import Differentiated, TrainingStep

NO_FRAME = FrameTensors("", {}, ())


class Steps:
    """Runs steps line by line, or records them and replays what was recorded.

    Args:
        schedule: Which of them each step takes.
        recorded: Record steps (recorded_steps.py), which CUDA can.

    Attributes:
        recordings: Those of the steps; None where they run line by line.
    """

    def __init__(
        self,
        step: TrainingStep,
        frames: TrainFrames,
        schedule: SpectrumSchedule,
        *,
        recorded: bool,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.step, self.frames, self.schedule = step, frames, schedule
        self._say = say
        size = step.config.batch_size or 1
        schedule.places = range(step.team.rank, size, step.team.size)
        for optimizers in step.state.optimizers.values():
            set_betas(optimizers, adam_betas(size))
        self.recordings = RecordedSteps(step, len(frames)) if recorded else None

    @contextmanager
    def run(self, kind: StepKind) -> Iterator[StepValues]:
        """Do the step that comes next; the block goes on with it, and ends before an interrupt is heard.

        Line by line, an interrupt ends the step as if it had not begun until the gradients are there. The next step
        overwrites the values of a recorded one.
        """
        plan = self.plan()
        if self.recordings is not None:
            frames = tuple(self.own_frames(plan, kind))
            with deferred_interrupts():
                yield self.recordings.run(frames, plan, kind)
            return
        done = self._gradients(plan, kind)
        with deferred_interrupts():  # from here on the step is done as a whole
            yield self.step.update(kind, done)

    def forget(self, *, kernels: bool = False) -> None:
        """Drop what was recorded: the tensors it works on are about to change, or have changed.

        Args:
            kernels: So does what is done with them, and with that the kernels that must be loaded.
        """
        if self.recordings is not None:
            self.recordings.forget(kernels=kernels)

    def check_overflow(self) -> None:
        """See whether all pairs of recorded steps had room; if not, they changed nothing, and the next get more."""
        if self.recordings is not None:
            self.recordings.check_overflow()

    def plan(self) -> Plan:
        """The frames of the step that comes next."""
        state, ranks = self.step.state, self.step.team.size
        shown = self.schedule.shown(state.step)
        batch = [self.frames.frames[index] for index in self.schedule.batch(state.step)]
        groups = [tuple(self._groups(frame, shown)) for frame in batch]
        seen = {name for of_frame in groups for group in of_frame for name in group}
        penalised = dict.fromkeys(state.model.set_of(name) for name in state.model.spectra if name in seen)
        rounds = (tuple(groups[start : start + ranks]) for start in range(0, len(groups), ranks))
        return Plan(tuple(penalised), tuple(rounds))

    def own_frames(self, plan: Plan, kind: StepKind) -> Iterator[FrameTensors]:
        """The frames that this rank renders in the step that comes next, one for each round."""
        for number, groups in enumerate(plan.rounds):
            has_one = self.step.team.rank < len(groups)
            step, factor = self.step.state.step, kind.image_factor
            yield self.schedule.tensors(step, number, factor=factor) if has_one else NO_FRAME

    def _groups(self, frame: Frame, shown: frozenset[str]) -> list[Group]:
        """The groups in which a rank renders a frame, as every rank finds them."""
        state = self.step.state
        names = [name for name in state.model.spectra if name in shown and name in frame.views]
        corrected = state.corrections is not None and not state.corrections.refined <= OF_FRAMES
        if corrected or state.separates_spectra or SHARED not in state.gaussian_sets:
            return [(name,) for name in names]
        groups = (tuple(name for name in names if name in group) for group in frame.shared_cameras)
        return [group for group in groups if group]

    def _gradients(self, plan: Plan, kind: StepKind) -> Differentiated:
        """Those of the step; where memory ends, again with fewer offloaded moments on the device.

        How much a step needs depends on how many Gaussians its camera sees. Until the gradients are there, nothing of
        the training's state has changed.
        """
        while True:
            try:
                return self.step.gradients(self.own_frames(plan, kind), kind, plan, fixed_capacity=False)
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
