"""The training loop: one frame per step, all its spectra at once.

    thermosplat-train data/shed                       on the GPU where there is one
    thermosplat-train sample                          about a minute on two CPU cores

Read :meth:`Trainer.train` for the run and :meth:`Trainer._train_step` for a step; everything they call says what it
does in its own file. Steps count from 1. The state is always that of a whole number of steps, whatever ends the run:
Ctrl-C, SIGTERM, a full memory or a bad loss.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from thermosplat.config import TrainConfig
from thermosplat.config.run_schedule import run_schedule, steps_note
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.geo_file import GEO_FILE
from thermosplat.datasets.kept_images import forget_images, keep_images
from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.errors import UserError
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.devices import choose_device
from thermosplat.runs.run_directory import FolderGoneError, RunDirectory
from thermosplat.scene.formations.saved_formations import as_trained
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.offloaded import offload
from thermosplat.stop_signals import deferred_interrupts, raise_lost_stop, signal_of
from thermosplat.training.batch_steps import BatchSteps
from thermosplat.training.budget.auto_budget import AutoBudget, Budget
from thermosplat.training.budget.noise_floor import noise_floors
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.budget.teacher import may_teach
from thermosplat.training.budget.tolerances import TOLERANCES
from thermosplat.training.camera_rounds import CameraRounds, finds_cameras, of_passes
from thermosplat.training.captured_batches import CapturedBatches
from thermosplat.training.captured_steps import CapturedSteps
from thermosplat.training.density.gaussian_limit import with_limit
from thermosplat.training.density.gaussian_ops import become_copy
from thermosplat.training.fast_decoders import fast_decoding
from thermosplat.training.finite_guard import FiniteGuard
from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.frames.resolution_schedule import most_gaussians, resolution_note
from thermosplat.training.frames.spectrum_schedule import SpectrumSchedule
from thermosplat.training.frames.train_frames import CorrectedFrames, TrainFrames
from thermosplat.training.image_noise import training_noise
from thermosplat.training.joined_scenes import Scene, joined_sets, kept_scene, seed_of_scene, steps_of_scene
from thermosplat.training.offloaded_steps import OffloadedSteps
from thermosplat.training.offloading import Offloaded, decided, limit_device_memory, refused
from thermosplat.training.plain_steps import PlainSteps
from thermosplat.training.sensor_facts import SensorFacts
from thermosplat.training.session.checkpoint_writer import (
    CheckpointWriter,
    going_on_without,
    naming_the_newest_checkpoint,
)
from thermosplat.training.session.fatal_errors import image_lost_error, not_finite_error
from thermosplat.training.session.greeting import greeting
from thermosplat.training.session.interruption import TrainingInterrupted, meanwhile
from thermosplat.training.session.out_of_memory import is_out_of_memory, out_of_memory_error
from thermosplat.training.session.resuming import (
    check_resumable,
    check_steps_left,
    newest_checkpoint,
    placed_as_trained,
)
from thermosplat.training.session.run_logger import RunLogger, StepRecord
from thermosplat.training.session.run_results import RunResults
from thermosplat.training.swept_depths.swept_depths import SweptDepths
from thermosplat.training.training_state import TrainingState
from thermosplat.training.training_step import StepKind, TrainingStep, sh_degree_at


class Trainer:
    """A training run.

    Args:
        config: The whole configuration.
        capture: The frames to learn from and to be judged by.
        run: Where everything goes.
        logger: What tells the user; None for the default one.
        checkpoint: State to go on from (``resuming.newest_checkpoint``); None starts from the capture's points.
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
    ) -> None:
        self.asked = self.config = config
        """The configuration as it was given and is kept; ``config`` is what it means for this capture and batches."""
        if checkpoint is not None:
            capture = placed_as_trained(capture, checkpoint)
        self.capture = capture
        self.run = run
        self.device = self._choose_device()
        if self.device.type == "cuda" and config.gpu_memory is not None:
            limit_device_memory(self.device, config.gpu_memory)
        self.frames = TrainFrames(capture, config.modelled, self.device)
        known = None if checkpoint is None else checkpoint.training.noisy
        facts = SensorFacts(config, partial(training_noise, self.frames), known)
        notes_of_steps = steps_note(config, len(self.frames), facts.noisy)
        self.config = config = run_schedule(config, len(self.frames), facts.noisy)
        self.logger = logger or self._make_logger()
        if checkpoint is not None:
            check_steps_left(checkpoint, config, run)
            # its noise has decided, whatever that of images of another size would
            trained = as_trained(config.modelled, checkpoint.model.decoders)
            config = replace(config, spectra={**config.spectra, **trained})
        config, notes_of_noise = facts.fitted(config, blur_is_known=checkpoint is not None)
        config, notes_of_limit = with_limit(config, capture, facts.noisy)
        self.config = config
        self.schedule = SpectrumSchedule(config, self.frames)
        self.budget: Budget | None = None
        self.offloaded: Offloaded | None = None
        """What lies in the host's memory; None: nothing was decided yet."""
        self.rows_on_device: dict[str, int] = {}
        """By set, Gaussians whose offloaded moments are on the device as long as it has room for them."""
        self.offload_notes: tuple[str, ...] = ()
        self.model = self._make_model(checkpoint, of_passes(config) if finds_cameras(config) else config)
        self.state = TrainingState(self.model, config, capture, self.device)
        self.state.noisy = facts.noisy
        self.state.keep_moments_on_device(self.rows_on_device)
        if checkpoint is not None:
            self.state.load(checkpoint)
            if self.state.noise_watch is not None and not self._teaches():
                self.state.noise_watch.forget_teachers()
        self._begin_scene()
        self.camera_rounds = self._make_camera_rounds()
        self.guard = FiniteGuard(self.device)
        floors, floor_notes = noise_floors(config, facts, self.tolerances.noise_floor)
        self.image_notes = (*notes_of_steps, *notes_of_noise, *floor_notes, *notes_of_limit)
        """What training images, their number and their noise, make of the configuration."""
        if self.state.noise_watch is not None:
            self.state.noise_watch.measured_anew(floors)
        elif floors:
            self.state.noise_watch = NoiseWatch(floors, len(self.frames), self.device)
            if not self.state.growing:
                self.state.noise_watch.end()
        self.device_step = TrainingStep(
            config,
            self.state,
            self.guard,
            PairCapacity(self.device),
            fast_decoding(self.model.formations, config, self.device),
            tolerances=self.tolerances,
        )
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)  # streams, graphs and their memory are those of the current one
        self.steps: PlainSteps | CapturedSteps | BatchSteps = self._make_steps()
        self.checkpoints = CheckpointWriter(self.logger.say)
        self.results = RunResults(config, capture, run, self.state, self.logger, self.device)
        self.between_steps: Callable[[Trainer], object] | None = None
        """Called after each step but the last, when the model is whole, by the thread that trains."""
        self._warm = False

    def _choose_device(self) -> torch.device:
        return choose_device(self.config.device)

    def _make_logger(self) -> RunLogger:
        config = self.config
        return RunLogger(
            self.run,
            max_steps=config.max_steps,
            log_every=config.log_every,
            device=self.device,
            tensorboard=config.tensorboard,
        )

    def _make_model(self, checkpoint: Checkpoint | None, config: TrainConfig) -> SceneModel:
        """The model of a checkpoint; without one, a new one as a configuration starts it."""
        if checkpoint is None:
            model = SceneModel.from_capture(config, self.capture, "cpu")
        else:
            model = SceneModel.from_checkpoint(checkpoint, "cpu")
        if self.offloaded is None:
            self.offloaded, note, rows = decided(self.config, model, self.device)
            self.offload_notes, self.rows_on_device = () if note is None else (note,), rows or {}
        for name in model.gaussian_sets if self.offloaded != "nothing" else ():
            offload(model.gaussians(name), self.device, parameters=self.offloaded == "all")
        return model.to(self.device)

    def _make_budget(self) -> Budget:
        frames = CorrectedFrames(self.frames, self.state.corrections)
        return AutoBudget(
            self.config,
            self.state,
            frames,
            self.schedule,
            tolerances=self.tolerances,
            teaches=self._teaches(),
            say=lambda line: self.logger.say(line),
        )

    def _teaches(self) -> bool:
        """Whether there is room for scenes as they were: what is offloaded has none on the device."""
        return self.offloaded == "nothing" and may_teach(self.model)

    def _make_camera_rounds(self) -> CameraRounds:
        return CameraRounds(self.config, self.state, self.frames)

    def _make_steps(self) -> "PlainSteps | CapturedSteps | BatchSteps":
        if (self.config.batch_size or 1) > 1:
            return self._batches(BatchSteps(self.device_step, self.frames, self.schedule))
        if self._captures:
            return CapturedSteps(self.device_step, len(self.frames))
        if self.rows_on_device:
            return OffloadedSteps(self.device_step, lambda line: self.logger.say(line))
        return PlainSteps(self.device_step)

    @property
    def _captures(self) -> bool:
        return self.device.type == "cuda" and self.config.graph and self.offloaded == "nothing"

    def _batches(self, batches: BatchSteps) -> BatchSteps | CapturedBatches:
        """Steps of several frames, recorded where that is possible."""
        return CapturedBatches(batches, len(self.frames)) if self._captures else batches

    @classmethod
    def resume(
        cls, config: TrainConfig, capture: Capture, run: RunDirectory, logger: RunLogger | None = None
    ) -> "Trainer":
        """Go on from the newest checkpoint of a run; on the CPU, with the same numbers as if it had never stopped.

        Args:
            config: The run's configuration; rates, schedule and device may differ from the first time, the model not.
            capture: The same capture as the first time.
            run: The run.
            logger: What tells the user; None for the default one.

        Raises:
            UserError: If there is no checkpoint, or it is of another model or capture than is asked for.
        """
        checkpoint = newest_checkpoint(run)
        check_resumable(checkpoint, config, run, capture)
        return cls(config, capture, run, logger, checkpoint)

    @property
    def step(self) -> int:
        """Steps done."""
        return self.state.step

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use after the steps done."""
        return sh_degree_at(self.config, self.state.step)

    # ---- the run -----------------------------------------------------------------------------------------------------

    def train(self) -> dict[str, Any]:
        """Train to ``max_steps``, evaluate, and write everything the run leaves behind.

        Returns:
            The content of metrics.json.

        Raises:
            TrainingInterrupted: After Ctrl-C and its like; carries the checkpoint and the command that goes on.
            UserError: If another process trains there, memory or (at the end) the disk is full, or a loss or gradient
                becomes NaN or infinite: says what was saved where.
        """
        with self.run.locked():
            return self._train()

    def _train(self) -> dict[str, Any]:
        config, state = self.config, self.state
        started = time.perf_counter() - state.seconds.wall
        try:
            self._begin()
            self._keep_images()
            if self.budget is not None:
                self.budget.do_what_is_due(self.sh_degree)
            self._leave_what_ended()  # of a resumed run that was stopped in its last step
            if self.results.lack_evaluation():  # a resumed run that was killed between a checkpoint and its evaluation
                self.results.evaluate()
            while state.step < config.max_steps:
                raise_lost_stop()
                self._train_step()
                state.seconds.wall = time.perf_counter() - started
                self.checkpoints.tell_failure()
                if self._looks_at_guard(state.step):
                    self._stop_if_folder_gone()
                if state.step < config.max_steps:
                    saving = not state.is_preliminary and state.step in config.save_steps
                    with going_on_without(self.logger.say), self._saving() if saving else nullcontext():
                        if not state.is_preliminary and state.step in config.eval_steps:
                            self.results.evaluate()
                    if self.between_steps is not None:
                        self.between_steps(self)
            if self.budget is not None:
                self.budget.finish(self.sh_degree)
            self._save()  # before pictures and other files take what room there is
            with naming_the_newest_checkpoint(self.run):
                with meanwhile(self.results.exporting()):
                    judged = self.results.evaluate(at_the_end=True)
                state.seconds.wall = time.perf_counter() - started
                metrics = self.results.write(judged)
            self.run.sweep()
            self._stop_if_folder_gone()
            self.frames.close()
            forget_images(self.capture)
            return metrics
        except (KeyboardInterrupt, Exception) as error:
            if isinstance(error, KeyboardInterrupt):
                with deferred_interrupts(redeliver=False):
                    self._stop_if_not_finite()
                    raise TrainingInterrupted(self._save(), self.run.resume_command(), signal_of(error)) from None
            if isinstance(error, ImageLostError):
                raise self._image_lost(error) from error
            if not is_out_of_memory(error):
                raise
            raise self._out_of_memory() from error
        finally:
            self.frames.close()
            self.logger.close()
            self.checkpoints.wait()

    def _begin(self, *first_words: str) -> None:
        """Write what the run is asked for, and say what is trained on what."""
        about_lpips = self.results.find_lpips()
        self.run.sweep()
        self.run.write_config(self.asked)
        self.run.write_environment(self.device)
        if self.capture.geo is not None:
            self.run.write_json(self.run.path / GEO_FILE, self.capture.geo.content())
        evaluates = self.state.step == self.config.max_steps or self.results.lack_evaluation()
        self.logger.start(self.state.step, evaluates=evaluates)
        for line in first_words:
            self.logger.say(line)
        self._greet(about_lpips)

    def _train_step(self) -> None:
        """One step: render a frame, compare it with its images, improve Gaussians and decoders."""
        config, state = self.config, self.state
        step, started = state.step + 1, time.perf_counter()
        # the scene on which cameras are found keeps its Gaussians: many small ones fit images through wrong cameras
        strategies = {} if state.finds_cameras else state.strategies
        densifying = any(strategy.is_active(step) for strategy in strategies.values())
        found_at = self.camera_rounds.image_factor
        kind = StepKind.at(config, step, densifying=densifying, cameras_found_at=found_at, taught=state.taught)
        frame = self.schedule.tensors(state.step, factor=kind.image_factor)
        budget = None if state.finds_cameras else self.budget
        rates = of_passes(config).optimizer if state.finds_cameras else config.optimizer
        if state.kept_scenes:  # scenes that become one have the same decoders
            rates = replace(rates, decoders_lr=0.0)
        state.begin_step(step, rates, self.capture.scene_extent)
        if kind.swept_depths:
            self.device_step.swept = self._swept_depths

        with self._first_step(), self.steps.run(frame, kind) as values:
            if self._looks_at_guard(step):
                self._stop_if_not_finite()
                self.steps.check_overflow()
            refining = {n: s for n, s in strategies.items() if s.refines_at(step) or s.resets_at(step)}
            pruning = budget is not None and budget.prunes_at(step)
            replacing = any(strategy.replaces_tensors(state.gaussian_sets[n]) for n, strategy in refining.items())
            if replacing or pruning:
                self.steps.forget(kernels=pruning)
            for name, strategy in refining.items():
                strategy.most = most_gaussians(config, kind.image_factor)
                self._refine(name, step)
            if budget is not None and budget.acts_at(step):
                budget.after_step(step, kind.sh_degree)
            self.camera_rounds.after_step(step, kind.sh_degree)
            for name, spectrum in config.modelled.items():
                if spectrum.start != "points" and step == state.spans[name].start:
                    self._start_from_other_set(name, spectrum.start)
            state.seconds.train += time.perf_counter() - started

        losses, errors = values.losses, values.squared_errors
        number = sum(map(state.num_gaussians, state.gaussian_sets))
        self.logger.step(StepRecord(step, losses, errors, number, kind.sh_degree, state.seconds.train))
        self._leave_what_ended()

    def _leave_what_ended(self) -> None:
        """Go on to what follows a pass of the cameras, or a scene, that is as far as it comes by itself."""
        if self.camera_rounds.pass_ends(self.state.step):
            self._start_anew("The scene starts anew with the cameras that were found.")
        elif self._scene_ends(self.state.step):
            self._end_scene()

    @cached_property
    def _swept_depths(self) -> SweptDepths:
        """Depths of the training views, swept when they are first asked for."""
        points = torch.from_numpy(self.capture.points)
        return SweptDepths.of(self.frames, self.config, points, lambda line: self.logger.say(line), self._all_can)

    def _all_can(self, can: bool) -> bool:
        """Whether all who train this scene can do something that this one can, or cannot."""
        return can

    def _start_anew(self, why: str, kept: Sequence[Scene] = ()) -> None:
        """Forget the scene; begin from the capture's points, with the cameras that were found.

        Args:
            why: What the user is told.
            kept: Scenes that are trained and are to become one with those to come.
        """
        with deferred_interrupts():
            self.steps.forget(kernels=True)
            self._forget_scene(kept)
            self._begin_scene()
            self.logger.start_again()
            self.logger.say(why)
            saved = self._save()
            for found_so_far in self.run.checkpoints():  # of more steps, so that one of them would be resumed from
                if found_so_far != saved:
                    found_so_far.unlink(missing_ok=True)

    def _forget_scene(self, kept: Sequence[Scene] = ()) -> None:
        state = self.state
        start = of_passes(self.config) if state.camera_passes > 1 else self.config
        model = self._make_model(None, replace(start, seed=seed_of_scene(self.config.seed, len(kept))))
        if kept:
            model.formations.load_state_dict(self.model.formations.state_dict())
        state.start_anew(model, kept)

    def _scene_ends(self, step: int) -> bool:
        """Whether the scene under way is one of several, and is as far as it comes by itself."""
        state = self.state
        return state.scenes_left > 0 and not state.finds_cameras and step >= steps_of_scene(self.config)

    @property
    def _scenes_of_limit(self) -> int:
        """Among how many scenes the limit of the Gaussians is divided now."""
        return self.config.scenes if self.state.scenes_left > 0 else 1

    def _end_scene(self) -> None:
        """Keep the scene and start another one, or let all become one. Until that is done the state is as it was."""
        state, scenes = self.state, self.config.scenes
        kept = [*state.kept_scenes, self._scene_to_keep()]
        if state.scenes_left > 1:
            self._start_anew(f"Scene {len(kept)} of {scenes} is trained; the next one starts anew.", kept)
            return
        sets = self._joined_sets(kept)
        with deferred_interrupts():
            self.steps.forget(kernels=True)
            self._join_scenes(sets)
            self._begin_scene()
        number = sum(map(state.num_gaussians, state.gaussian_sets))
        self.logger.say(f"All {scenes} scenes become one of {number:,} Gaussians.")

    def _scene_to_keep(self) -> Scene:
        return kept_scene(self.model)

    def _joined_sets(self, scenes: Sequence[Scene]) -> dict[str, Gaussians]:
        return joined_sets(scenes, self.config, self.model.formations)

    def _join_scenes(self, sets: Mapping[str, Gaussians]) -> None:
        self.state.take(sets)
        self.state.kept_scenes, self.state.scenes_left = [], 0

    def _begin_scene(self) -> None:
        """What a scene needs that starts, or goes on: frames in its order, and those withheld that it withholds."""
        config, state = self.config, self.state
        self.schedule.shuffle(state.seed)
        self.budget = self._make_budget() if config.budget == "auto" else None
        if config.scenes > 1:
            trained = len(state.kept_scenes)
            self.logger.scene = f"scene {trained + 1} of {config.scenes}: " if state.scenes_left > 0 else ""
            self.logger.steps_of_others = max(state.scenes_left - 1, 0) * steps_of_scene(config)

    def _refine(self, name: str, step: int) -> None:
        """Let density control add and remove Gaussians of a set."""
        state, random = self.state, random_stream(self.state.seed, "split", step)
        state.strategies[name].refine(state.gaussian_sets[name], state.optimizers[name], step, random)

    def _start_from_other_set(self, name: str, source: str) -> None:
        """Make a spectrum's set a copy of another one's trained set, to be trained anew from it."""
        state = self.state
        self.steps.forget()
        become_copy(state.gaussian_sets[name], state.optimizers[name], state.gaussian_sets[source])
        state.strategies[name].forget(len(state.gaussian_sets[name]))

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

    def _greet(self, lpips: str) -> None:
        """Say once what is trained on what, and what the capture has to say."""
        numbers = map(self.state.num_gaussians, self.state.gaussian_sets)
        counts = {"num_frames": len(self.frames), "num_gaussians": sum(numbers)}
        about = greeting(self.config, self.capture, self.run, self.device, step=self.state.step, **counts)
        notes = (*self.capture.notes, *self.image_notes, *self.offload_notes)
        for line in (*notes, lpips, *about, *resolution_note(self.config)):
            self.logger.say(line)
        if self.state.finds_cameras:
            passes, steps = self.state.camera_passes, self.camera_rounds.steps
            self.logger.say(f"The cameras are found first: {passes} times {steps:,} steps, and each time a new scene.")

    def _keep_images(self) -> None:
        """Of a capture whose images stay on the disk: keep what is made of them in the result folder."""
        for line in keep_images(self.capture, self.run.path):
            self.logger.say(line)

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def corrected_capture(self) -> Capture:
        """The capture with its cameras as they are believed to be now."""
        return self.results.corrected_capture()

    def _checkpoint(self) -> tuple[Path, dict[str, Any]]:
        """File and content of a checkpoint of the steps done; callers have made sure that the state is finite."""
        checkpoint = self.state.checkpoint(self.asked, self.sh_degree, self.capture.scales, self.capture)
        return self.run.checkpoint(self.state.step), checkpoint.state()

    def _saving(self) -> AbstractContextManager[None]:
        """Around what leaves the model as it is: begin to write a checkpoint of the steps done."""
        return self.checkpoints.beginning(*self._checkpoint())

    def save(self) -> Path:
        """Write a checkpoint between two steps; the file.

        Raises:
            UserError: It cannot be written, or a loss was NaN or infinite.
        """
        self._stop_if_not_finite()
        return self._save()

    def _save(self) -> Path:
        """Write a checkpoint of the steps done, at once."""
        with naming_the_newest_checkpoint(self.run), deferred_interrupts():
            self._stop_if_folder_gone()
            return self.checkpoints.write_last(self.run, *self._checkpoint())

    # ---- when it goes wrong ------------------------------------------------------------------------------------------

    def _looks_at_guard(self, step: int) -> bool:
        """Whether to wait for the device after this step: where a bad state would spread or be kept."""
        config = self.config
        return (
            self.device.type == "cpu"  # nothing to wait for
            or step % config.log_every == 0
            or step in (*config.eval_steps, *config.save_steps, config.max_steps)
            or any(step == span.start for span in self.state.spans.values())
            or any(strategy.refines_at(step) or strategy.resets_at(step) for strategy in self.state.strategies.values())
            or (self.budget is not None and self.budget.acts_at(step))
            or self.camera_rounds.pass_ends(step)
            or self._scene_ends(step)
        )

    def _stop_if_not_finite(self) -> None:
        """Raise if a loss or gradient was NaN or infinite; the state from before that step is saved."""
        found = self.guard.first_bad()
        if found is None:
            return
        bad_step, name = found
        self.state.step = bad_step - 1  # the guard has kept every update since from being made
        frame = self.schedule.frame(self.state.step)
        where, suspects = f"frame: {frame.name}", "the pose of that frame"
        raise not_finite_error(bad_step, name, where, suspects, self._save(), self.run.resume_command())

    def _stop_if_folder_gone(self) -> None:
        """Raise if the result folder was renamed or removed; what was trained is saved where it is now, or anew."""
        try:
            self.run.check_is_there()
        except FolderGoneError as gone:
            self.run.move(gone.now)
            self._stop_if_not_finite()
            message = f"{gone.message} What was trained is saved to {self._save()}."
            raise UserError(message, f"Go on with: {self.run.resume_command()}") from gone

    def _image_lost(self, error: ImageLostError) -> UserError:
        """Save what there is; the error says which image is to be restored."""
        self._stop_if_not_finite()
        return image_lost_error(error, f"Checkpoint saved to {self._save()}.", self.run.resume_command())

    def _out_of_memory(self) -> UserError:
        """Save what there is; the error says what would need less memory."""
        failed, num_gaussians = self.state.step + 1, self.model.num_gaussians
        self.state.clear_gradients()
        self.steps.forget()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        self._stop_if_not_finite()
        frame = self.schedule.frame(self.state.step)
        camera = next(iter(frame.views.values())).camera
        return out_of_memory_error(
            failed,
            num_gaussians,
            f"{camera.width}x{camera.height}",
            self.device,
            f"Checkpoint saved to {self._save()}.",
            self.run.resume_command(),
            can_offload=self.device.type == "cuda" and self.offloaded != "all" and refused(self.config) is None,
            scenes=self._scenes_of_limit,
        )
