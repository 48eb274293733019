"""What keeps a training from being lost: its checkpoints, and errors that say where they are and how to go on.

A checkpoint is the whole training of all ranks, written by rank 0. Where a rank fails within a step the state lies in
the memories of all, which make no calls any more: then the newest checkpoint is what there is.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.distributed.team import EndedElsewhere
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.run_directory import FolderGoneError
from thermosplat.stop_signals import deferred_interrupts, signal_of
from thermosplat.training.out_of_memory import is_out_of_memory, out_of_memory_error
from thermosplat.training.session.checkpoint_writer import (
    CheckpointWriter,
    going_on_without,
    naming_the_newest_checkpoint,
)
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.session.training_parts import Training
from thermosplat.training.sharing.shares import whole_checkpoint
from thermosplat.training.step_kind import sh_degree_at
from thermosplat.training.training_state import TrainingState

GATHERING = 5.0
"""How long a checkpoint that is being gathered is waited for where a rank has failed, which may have its part [s]."""


class Safekeeping:
    """The checkpoints of a training, and its errors.

    Attributes:
        newest_checkpoint: Rank 0 knows it, whose host alone may have the folder: whoever lets ranks talk says how it is
            asked.
    """

    def __init__(self, training: Training) -> None:
        self._training, self._guard = training, training.steps.step.guard
        self._team, self._state, self._run = training.team, training.state, training.run
        self.writer = CheckpointWriter(training.say)
        self._gathering = threading.Lock()
        self.newest_checkpoint: Callable[[], Path | None] = training.run.latest_checkpoint

    def gathered(self, *, training: bool) -> Checkpoint | None:
        """The checkpoint of all ranks together, on rank 0; None on the others.

        Args:
            training: With Adam's moments; without them it can be rendered.
        """
        own = self.checkpoint_of(self._state)
        return whole_checkpoint(self._team, self._state, own, training=training and not self._state.budget.trimmed)

    def checkpoint_of(self, state: TrainingState) -> Checkpoint:
        """The checkpoint of a state, this rank's or one of all ranks."""
        training, recipe = self._training, self._training.recipe
        degree = sh_degree_at(training.config, state.step)
        found = state.checkpoint(recipe.asked, degree, training.capture.scales, training.capture)
        return replace(found, training=replace(found.training, noisy=recipe.noisy))

    @contextmanager
    def saving_meanwhile(self) -> Iterator[None]:
        """Around what leaves the model as it is: begin to write a checkpoint, which is done while training goes on."""
        with ExitStack() as begun:
            with self._gathering:
                whole = self.gathered(training=True)
                if whole is not None:
                    begun.enter_context(going_on_without(self._training.say))
                    begun.enter_context(self.writer.beginning(self._file(), whole.state()))
            yield

    def save(self) -> Path:
        """Write a checkpoint between two steps, by all ranks; the file.

        Raises:
            UserError: It cannot be written, or a loss was NaN or infinite.
        """
        self.check_finite()
        return self._write()

    def _write(self) -> Path:
        with deferred_interrupts():
            if self._team.is_alone:
                self.check_folder()
            whole = self.gathered(training=True)

            def write() -> Path:
                with naming_the_newest_checkpoint(self._run):
                    return self.writer.write_last(self._run, self._file(), given(whole).state())

            return self._team.asked_of_first(write)

    def _file(self) -> Path:
        return self._run.checkpoint(self._state.step)

    def finish_writing(self) -> None:
        """Let a checkpoint that is under way come to its end; for other threads, when all are about to end."""
        if self._gathering.acquire(timeout=GATHERING):
            self._gathering.release()
        self.writer.wait()

    def check_finite(self) -> None:
        """Raise if a loss or gradient was NaN or infinite on any rank; the state from before that step is saved."""
        team = self._team
        found = team.objects(self._guard.first_bad())
        bad = [(entry, rank) for rank, entry in enumerate(found) if entry is not None]
        if not bad:
            return
        (bad_step, name), rank = min(bad)
        self._state.step = bad_step - 1  # the guard has kept every update since from being made, on all ranks
        where, suspects = f"on rank {rank}", "the poses of the capture"
        if team.is_alone:
            where, suspects = f"frame: {self._training.schedule.frame(self._state.step).name}", "the pose of that frame"
        saved = self._write()
        if not team.is_first:
            raise EndedElsewhere(2)
        raise not_finite_error(bad_step, name, where, suspects, saved, self._run.resume_command())

    def check_folder(self) -> None:
        """Raise if the result folder was renamed or removed; what was trained is saved where it is now, or anew."""
        try:
            self._run.check_is_there()
        except FolderGoneError as gone:
            self._run.move(gone.now)
            message = f"{gone.message} What was trained is saved to {self.save()}."
            raise UserError(message, f"Go on with: {self._run.resume_command()}") from gone

    @contextmanager
    def ending_well(self) -> Iterator[None]:
        """Around a training: where it stops, what can be saved is saved, and the error says how to go on.

        Raises:
            TrainingInterrupted: In place of an interrupt.
            UserError: In place of what comes of a full memory, or of an image that is gone.
        """
        try:
            yield
        except (KeyboardInterrupt, Exception) as error:
            if isinstance(error, KeyboardInterrupt) and self._team.is_alone:
                with deferred_interrupts(redeliver=False):
                    raise self.interrupted(signal_of(error)) from None
            if isinstance(error, ImageLostError):
                raise image_lost_error(error, self._what_is_saved(), self._run.resume_command()) from error
            if not is_out_of_memory(error):
                raise
            raise self._out_of_memory() from error

    def interrupted(self, number: int) -> TrainingInterrupted:
        """Save what there is; what says so, and that a signal has ended the training."""
        return TrainingInterrupted(self.save(), self._run.resume_command(), number)

    def _what_is_saved(self) -> str:
        """One sentence about what there is to go on from; of one process that is the state of now."""
        if self._team.is_alone:
            return f"Checkpoint saved to {self.save()}."
        latest = self.newest_checkpoint()
        return "No checkpoint is saved." if latest is None else f"The newest checkpoint that is saved: {latest}."

    def _out_of_memory(self) -> UserError:
        """Save what there is; the error says what would need less memory."""
        training, state, team = self._training, self._state, self._team
        failed, number = state.step + 1, training.state.all_gaussians
        state.clear_gradients()
        training.steps.forget()
        if team.device.type == "cuda":
            torch.cuda.empty_cache()
        saved = self._what_is_saved()
        if not team.is_alone:
            saved = f"On rank {team.rank} of {team.size}, with a share of the Gaussians. {saved}"
        camera = next(iter(training.schedule.frame(state.step).views.values())).camera
        return out_of_memory_error(
            failed,
            number,
            f"{camera.width}x{camera.height}",
            team.device,
            saved,
            self._run.resume_command(),
            can_offload=training.scenes.could_offload,
            scenes=training.config.scenes if state.preliminaries.scenes_left > 0 else 1,
        )


def given(checkpoint: Checkpoint | None) -> Checkpoint:
    """What ``gathered`` gave, on rank 0, which alone has it."""
    if checkpoint is None:
        raise RuntimeError("Only rank 0 has the whole checkpoint.")
    return checkpoint


def not_finite_error(step: int, term: str, where: str, suspects: str, saved: object, resume_command: str) -> UserError:
    """The error of a loss or gradient that is NaN or infinite.

    Args:
        step: The step that failed; its update was not made.
        term: The loss, or the tensor whose gradient it is.
        suspects: What to look at, after "Check the images and".
    """
    return UserError(
        f"The loss became NaN or infinite at step {step:,} (term: {term}; {where}). "
        f"Last finite state saved to {saved}.",
        f"Check the images and {suspects}, then go on with: {resume_command} "
        "Or start again with smaller learning rates (--optimizer.means-lr and the others).",
    )


def image_lost_error(lost: ImageLostError, saved: str, resume_command: str) -> UserError:
    """The error of an image that cannot be read any more.

    Args:
        lost: Which image, and what is to be done about it.
    """
    return UserError(f"{lost.message} {saved}", f"{lost.hint} Then go on with: {resume_command}".lstrip())
