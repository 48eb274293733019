"""The training loop: one frame per step, all its spectra at once.

    thermosplat-train data/shed                       on the GPU where there is one
    thermosplat-train sample                          about a minute on two CPU cores

A training is a recipe (recipe.py: what is done), a team (distributed/team.py: who does it) and stages (stages/: what is
done between steps). Read :meth:`Trainer.train` for the run and :meth:`Trainer.train_step` for a step; everything they
call says what it does in its own file. Steps count from 1. The state is always that of a whole number of steps,
whatever ends the run: Ctrl-C, SIGTERM, a full memory or a bad loss.

All ranks of a team train; rank 0 speaks, evaluates and writes. What concerns the whole model is done by rank 0 on a
whole copy while the others wait. A signal to any rank is acted on by all after the step that is under way.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.geo_file import GEO_FILE
from thermosplat.datasets.kept_images import forget_images, keep_images
from thermosplat.distributed.team import Team
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.devices import choose_device
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.stop_signals import raise_lost_stop
from thermosplat.training.budget.tolerances import TOLERANCES
from thermosplat.training.session.greeting import greeting
from thermosplat.training.session.resuming import share_to_go_on_from
from thermosplat.training.session.run_logger import RunLogger, StepRecord
from thermosplat.training.session.run_results import RunResults
from thermosplat.training.session.safekeeping import Safekeeping
from thermosplat.training.session.training_parts import Training
from thermosplat.training.sharing.meetings import Meetings
from thermosplat.training.stages.all_stages import stages_of
from thermosplat.training.stages.auto_budget import AutoBudget
from thermosplat.training.stages.budgets import BudgetStage
from thermosplat.training.stages.scenes import Beginnings
from thermosplat.training.step_kind import StepKind


class Trainer:
    """A training run, as one of the ranks of a team has it.

    Args:
        config: The whole configuration, the same on every rank.
        capture: The frames to learn from and to be judged by, the same on every rank.
        run: Where everything goes; rank 0 writes there, and the others look at nothing in it.
        logger: What tells the user; None for the default one, which is silent but on rank 0.
        checkpoint: State to go on from, of several ranks this one's share; None starts from the capture's points.
        team: The ranks; None: this process alone.
    """

    tolerances = TOLERANCES
    """What ``--budget auto`` may change."""

    def __init__(
        self,
        config: TrainConfig,
        capture: Capture,
        run: RunDirectory,
        logger: RunLogger | None = None,
        checkpoint: Checkpoint | None = None,
        team: Team | None = None,
    ) -> None:
        team = Team.of_one(choose_device(config.device)) if team is None else team
        parts = Training.of(config, capture, run, logger, checkpoint, team, self.tolerances)
        self.parts, self.team, self.device, self.run = parts, team, team.device, run
        self.capture, self.frames, self.schedule = parts.capture, parts.frames, parts.schedule
        self.recipe, self.config, self.logger = parts.recipe, parts.config, parts.logger
        self.state, self.steps, self.device_step = parts.state, parts.steps, parts.steps.step
        self.guard = self.device_step.guard
        self.keeping = Safekeeping(parts)
        self.beginnings = Beginnings(parts, self.keeping)
        self.stages = stages_of(parts, self.keeping, self.beginnings, self.tolerances)
        self.beginnings.stages = self.stages
        self.beginnings.begin_scene()
        self.meetings = Meetings(team)
        self.results = RunResults(parts, self.keeping, self.meetings)
        self.between_steps: Callable[[Trainer], object] | None = None
        """Called after each step but the last, when the model is whole, by the thread that trains."""
        self._warm = False

    @classmethod
    def resume(
        cls,
        config: TrainConfig,
        capture: Capture,
        run: RunDirectory,
        team: Team | None = None,
    ) -> "Trainer":
        """Go on from the newest checkpoint of a run; on the CPU, with the same numbers as if it had never stopped.

        The run may have been one of another number of ranks. Rank 0 reads the checkpoint.

        Args:
            config: The run's configuration; rates, schedule and device may differ from the first time, the model not.
            capture: The same capture as the first time.
            team: The ranks; None: this process alone.

        Raises:
            UserError: If there is no checkpoint, or it is of another model or capture than is asked for.
        """
        team = Team.of_one(choose_device(config.device)) if team is None else team
        checkpoint = share_to_go_on_from(config, capture, run, team)
        return cls(config, capture, run, checkpoint=checkpoint, team=team)

    @property
    def model(self) -> SceneModel:
        """The scene, of several ranks this one's share."""
        return self.state.model

    @property
    def budget(self) -> AutoBudget | None:
        """What ``--budget auto`` does with the scene under way; None without it."""
        return next((stage.plan for stage in self.stages if isinstance(stage, BudgetStage)), None)

    @property
    def step(self) -> int:
        """Steps done."""
        return self.state.step

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use after the steps done."""
        return self.parts.sh_degree

    # ---- the run -----------------------------------------------------------------------------------------------------

    def train(self) -> dict[str, Any]:
        """Train to ``max_steps``, evaluate, and write everything the run leaves behind.

        Returns:
            The content of metrics.json; of ranks that are not the first, nothing.

        Raises:
            TrainingInterrupted: After Ctrl-C and its like; carries the checkpoint and the command that goes on.
            UserError: If another process trains there, memory or (at the end) the disk is full, or a loss or gradient
                becomes NaN or infinite: says what was saved where.
        """
        with self.run.locked() if self.team.is_first else nullcontext(), self.meetings.listening():
            try:
                with self.keeping.ending_well():
                    return self._train()
            finally:
                self.steps.forget()  # NCCL does not end as long as there are recordings of its exchanges
                self.frames.close()
                self.logger.close()
                self.keeping.writer.wait()

    def _train(self) -> dict[str, Any]:
        state, max_steps, first = self.state, self.config.max_steps, self.team.is_first
        started = time.perf_counter() - state.seconds.wall
        self.meetings.by_first(self._begin, to_its_end=True)
        for line in keep_images(self.capture, self.run.path):
            self.logger.say(line)
        self._leave_what_ended()  # of a resumed run that was stopped in its last step
        # a resumed run that was killed between a checkpoint and its evaluation
        if self.team.object_of_first(first and self.results.lack_evaluation()):
            self.results.evaluate_on_the_way()
            self._stop_if_wished()
        while state.step < max_steps:
            raise_lost_stop()
            self.train_step()
            state.seconds.wall = time.perf_counter() - started
            self.keeping.writer.tell_failure()
            if self.team.is_alone and self.looks_at_guard(state.step):
                self.keeping.check_folder()
            self._stop_if_wished()
            if state.step < max_steps:
                self._save_and_evaluate()
                if self.between_steps is not None:
                    self.between_steps(self)
                    if self.meetings.called:
                        self._stop_if_wished()
        for stage in self.stages:
            stage.finish()
        self.save()  # before pictures and other files take what room there is
        metrics = self.results.leave_behind(started)
        if self.team.is_alone:
            self.keeping.check_folder()
        self._stop_if_wished()
        self.frames.close()
        if first:
            forget_images(self.capture)
        return metrics

    def train_step(self) -> None:
        """One step: render frames, compare them with their images, improve Gaussians and decoders."""
        config, state = self.config, self.state
        step, started = state.step + 1, time.perf_counter()
        kind, rates = StepKind.at(config, step), config.optimizer
        for stage in self.stages:
            kind, rates = stage.before(step, kind), stage.rates(rates)
        state.begin_step(step, rates)

        with self._first_step(), self.steps.run(kind) as values:
            if self.looks_at_guard(step):
                self.keeping.check_finite()
                self.steps.check_overflow()
            for stage in self.stages:
                if stage.acts_at(step):
                    stage.after(step, kind)
            state.seconds.train += time.perf_counter() - started

        losses, errors = values.losses, values.squared_errors
        number = state.all_gaussians
        self.logger.step(StepRecord(step, losses, errors, number, kind.sh_degree, state.seconds.train))
        self._leave_what_ended()

    def _leave_what_ended(self) -> None:
        """Go on to what follows the step done."""
        for stage in self.stages:
            stage.leave()

    def looks_at_guard(self, step: int) -> bool:
        """Whether to wait for the device after this step: where a bad state would spread or be kept."""
        config = self.config
        return (
            self.device.type == "cpu"  # nothing to wait for
            or step % config.log_every == 0
            or step in (*config.eval_steps, *config.save_steps, config.max_steps)
            or any(stage.acts_at(step) for stage in self.stages)
        )

    @contextmanager
    def _first_step(self) -> Iterator[None]:
        """Around what compiles kernels in the first step of a process; times it."""
        if self._warm:
            yield
            return
        started = time.perf_counter()
        with self.logger.compiling():
            yield
        self.state.seconds.first_step, self._warm = time.perf_counter() - started, True

    # ---- beginning, evaluations and end ------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Write what the run is asked for, and say what is trained on what."""
        about_lpips = self.results.find_lpips()
        self.run.sweep()
        self.run.write_config(self.recipe.asked)
        self.run.write_environment(self.device)
        if self.capture.geo is not None:
            self.run.write_json(self.run.path / GEO_FILE, self.capture.geo.content())
        evaluates = self.step == self.config.max_steps or self.results.lack_evaluation()
        self.logger.start(self.step, evaluates=evaluates)
        notes = (*self.capture.notes, *self.recipe.notes, *self.parts.scenes.notes, about_lpips)
        for line in (*greeting(self.parts, notes), *(line for stage in self.stages for line in stage.notes())):
            self.logger.say(line)

    def _save_and_evaluate(self) -> None:
        """Do with the step done what the configuration says, unless its scene is no result of the run."""
        step, config = self.step, self.config
        if self.state.preliminaries.under_way:
            return
        with self.keeping.saving_meanwhile() if step in config.save_steps else nullcontext():
            if step in config.eval_steps:
                self.results.evaluate_on_the_way()
        if step in config.eval_steps:
            self._stop_if_wished()

    def corrected_capture(self) -> Capture:
        """The capture with its cameras as they are believed to be now."""
        return self.results.corrected_capture()

    def save(self) -> Path:
        """Write a checkpoint between two steps, by all ranks; the file.

        Raises:
            UserError: It cannot be written, or a loss was NaN or infinite.
        """
        return self.keeping.save()

    def _stop_if_wished(self) -> None:
        """Save and stop where a signal was sent to any rank; hear whether rank 0 calls all ranks together."""
        number = self.meetings.signal_to_any()
        if number:
            raise self.keeping.interrupted(number)
