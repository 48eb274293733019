"""A training run on several ranks: what of ``Trainer`` is done by all, and what by rank 0 alone.

All ranks train; rank 0 speaks, evaluates and writes. What concerns the whole model (an evaluation, a checkpoint, a
budget's removal) is done by rank 0 on a whole copy while the others wait. A signal to any rank is acted on by all after
the step that is under way.
"""

import io
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.kept_images import forget_images
from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.distributed.team import EndedElsewhere, Team
from thermosplat.errors import UserError
from thermosplat.printing import SafeConsole
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.auto_budget import Budget
from thermosplat.training.camera_rounds import CameraRounds
from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.joined_scenes import Scene
from thermosplat.training.offloading import refused
from thermosplat.training.session.checkpoint_writer import going_on_without, naming_the_newest_checkpoint
from thermosplat.training.session.fatal_errors import image_lost_error, not_finite_error
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.session.out_of_memory import is_out_of_memory, out_of_memory_error
from thermosplat.training.session.resuming import check_resumable, newest_checkpoint
from thermosplat.training.session.run_logger import RunLogger
from thermosplat.training.sharing.divided_budget import DividedBudget
from thermosplat.training.sharing.refining import refine_divided
from thermosplat.training.sharing.shares import (
    divided_sets,
    keep_share,
    shared_counts,
    shares_of,
    whole_checkpoint,
)
from thermosplat.training.sharing.stopping import StopWish, stop_wishes
from thermosplat.training.trainer import Trainer

GATHERING = 5.0
"""How long a checkpoint that is being gathered is waited for where a rank has failed, which may have its part [s]."""


class DividedTrainer(Trainer):
    """A training run, as one of several ranks has it; see ``Trainer``.

    Args:
        config: The whole configuration, the same on every rank.
        capture: The capture, the same on every rank.
        run: Where everything goes; rank 0 writes there, and the others look at nothing in it.
        team: The ranks.
        logger: What tells the user; None for the default one, which is silent but on rank 0.
        checkpoint: This rank's share of the state to go on from; None starts from the capture's points.
    """

    def __init__(
        self,
        config: TrainConfig,
        capture: Capture,
        run: RunDirectory,
        team: Team,
        logger: RunLogger | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        if config.offload in ("on", "moments") and (why := refused(config, divided=True)) is not None:
            raise UserError(why, "Leave --offload out.")
        self._team = team
        self._counts: dict[str, list[int]] = {}
        self.wish = StopWish()
        self.calls: Callable[[], bool] = lambda: False
        """On rank 0: whether all ranks are to come together after the step."""
        self.called = False
        """Whether rank 0 has called all ranks together: ``between_steps`` of all of them is where they meet."""
        self._gathering = threading.Lock()
        self.newest_checkpoint: Callable[[], Path | None] = run.latest_checkpoint
        """Rank 0 knows it, whose host alone may have the folder: whoever lets ranks talk says how it is asked."""
        super().__init__(config, capture, run, logger, checkpoint)
        self.state.counts = self._counts
        self.tell_blocks()

    @classmethod
    def resume_divided(
        cls, config: TrainConfig, capture: Capture, run: RunDirectory, team: Team, logger: RunLogger | None = None
    ) -> "DividedTrainer":
        """Go on from the newest checkpoint of a run, which may be of another number of ranks; rank 0 reads it.

        Raises:
            UserError: As of ``Trainer.resume``, on rank 0.
        """

        shares: list[Checkpoint] = []

        def read() -> None:
            checkpoint = newest_checkpoint(run)
            check_resumable(checkpoint, config, run, capture)
            shares.extend(shares_of(checkpoint, team.size))

        team.asked_of_first(read)
        share = team.dealt(shares if team.is_first else None)
        return cls(config, capture, run, team, logger, share)

    # ---- what a rank has ---------------------------------------------------------------------------------------------

    def _choose_device(self) -> torch.device:
        return self._team.device

    def _choose_team(self) -> Team:
        return self._team

    def _make_logger(self) -> RunLogger:
        if self.team.is_first:
            return super()._make_logger()
        never = 2**62
        silent = SafeConsole(quiet=True, file=io.StringIO())
        return RunLogger(
            self.run, max_steps=never, log_every=never, device=self.device, tensorboard=False, console=silent
        )

    def _make_model(self, checkpoint: Checkpoint | None, config: TrainConfig) -> SceneModel:
        self.offloaded = "nothing"
        if checkpoint is None:
            model = SceneModel.from_capture(config, self.capture, "cpu")
            self._counts = keep_share(model, self.team)
            return model.to(self.device)
        model = SceneModel.from_checkpoint(checkpoint, self.device)
        self._counts = shared_counts(self.team, model)
        return model

    def _make_budget(self) -> Budget:
        return DividedBudget(self)

    def _teaches(self) -> bool:
        """Ranks would have to render the scene of then together, too: they hold spectra by floors."""
        return False

    def _all_can(self, can: bool) -> bool:
        return all(number for (number,) in self.team.numbers([can]))

    def _make_camera_rounds(self) -> CameraRounds:
        return CameraRounds(self.config, self.state, self.frames, self.team)

    def tell_blocks(self) -> None:
        """Tell density control which Gaussians of all this rank has."""
        for name, counts in (self.state.counts or {}).items():
            self.state.strategies[name].block = (sum(counts[: self.team.rank]), sum(counts))

    def _forget_scene(self, kept: Sequence[Scene] = ()) -> None:
        super()._forget_scene(kept)
        self.state.counts = self._counts
        self.tell_blocks()

    def _scene_to_keep(self) -> Scene:
        """The whole scene, on rank 0; the others hold its place."""
        whole = self.gathered(training=False)
        return {} if whole is None else whole.model.gaussian_sets

    def _joined_sets(self, scenes: Sequence[Scene]) -> dict[str, Gaussians]:
        """This rank's share of the Gaussians of all scenes."""
        shares: list[dict[str, Gaussians]] = []
        whole = super()._joined_sets
        self.team.asked_of_first(lambda: shares.extend(divided_sets(whole(scenes), self.team.size)))
        share: dict[str, Gaussians] = self.team.dealt(shares if self.team.is_first else None)
        return share

    def _join_scenes(self, sets: Mapping[str, Gaussians]) -> None:
        super()._join_scenes(sets)
        self.state.counts = self._counts = shared_counts(self.team, self.model)
        self.tell_blocks()

    def _refine(self, name: str, step: int) -> None:
        self.steps.forget()  # ranks divide all rows anew, also where one process would change them in place
        random = random_stream(self.state.seed, "split", step)
        refine_divided(self.team, self.state, name, self.config.densification, step, random)
        self.tell_blocks()

    def _start_from_other_set(self, name: str, source: str) -> None:
        super()._start_from_other_set(name, source)
        counts = self.state.counts or {}
        counts[name] = list(counts[source])
        self.tell_blocks()

    # ---- the run -----------------------------------------------------------------------------------------------------

    def train(self) -> dict[str, Any]:
        """As ``Trainer.train``; the other ranks get no numbers."""
        with self.run.locked() if self.team.is_first else nullcontext(), stop_wishes(self.wish):
            return self._train()

    def _train(self) -> dict[str, Any]:
        config, state, first = self.config, self.state, self.team.is_first
        started = time.perf_counter() - state.seconds.wall
        try:
            ranks = f"{self.team.size} devices, {config.batch_size} frames per step."
            self._alone(lambda: self._begin(f"The Gaussians are divided over {ranks}"), to_its_end=True)
            self._keep_images()
            if self.budget is not None:
                self.budget.do_what_is_due(self.sh_degree)
            self._leave_what_ended()
            if self.team.object_of_first(first and self.results.lack_evaluation()):
                self._evaluate_whole()
            while state.step < config.max_steps:
                self._train_step()
                state.seconds.wall = time.perf_counter() - started
                if first:
                    self.checkpoints.tell_failure()
                self._stop_if_wished()
                if state.step < config.max_steps:
                    if not state.is_preliminary and state.step in config.save_steps:
                        self._save_meanwhile()
                    if not state.is_preliminary and state.step in config.eval_steps:
                        self._evaluate_whole()
                    if self.between_steps is not None:
                        self.between_steps(self)
                        if self.called:
                            self._stop_if_wished()
            if self.budget is not None:
                self.budget.finish(self.sh_degree)
            self._save()
            metrics = self._alone_with_whole(lambda whole: self._leave_behind(whole, started))
            self._stop_if_wished()
            self.frames.close()
            if first:
                forget_images(self.capture)
            return metrics or {}
        except Exception as error:
            if isinstance(error, ImageLostError):
                raise image_lost_error(error, self._what_is_saved(), self.run.resume_command()) from error
            if not is_out_of_memory(error):
                raise
            raise self._out_of_memory() from error
        finally:
            self.steps.forget()  # NCCL does not end as long as there are recordings of its exchanges
            self.frames.close()
            self.logger.close()
            self.checkpoints.wait()

    def _leave_behind(self, whole: SceneModel, started: float) -> dict[str, Any]:
        """What a finished run leaves, from the whole model."""
        with naming_the_newest_checkpoint(self.run), self._as_model(whole):
            self.results.exporting()()
            judged = self.results.evaluate(at_the_end=True)
            self.state.seconds.wall = time.perf_counter() - started
            metrics = self.results.write(judged)
        self.run.sweep()
        return metrics

    # ---- what rank 0 does alone --------------------------------------------------------------------------------------

    def _alone(self, work: Callable[[], Any], *, to_its_end: bool = False) -> Any:
        """Let rank 0 do something while the others wait; what it gives, None on the others.

        Args:
            work: What to do.
            to_its_end: A signal waits until it is done, rather than end it.
        """
        held: list[Any] = []

        def done() -> None:
            with nullcontext() if to_its_end else self.wish.heard_at_once():
                held.append(work())

        self.team.asked_of_first(done)
        return held[0] if held else None

    def _alone_with_whole(self, work: Callable[[SceneModel], Any]) -> Any:
        """Let rank 0 do something with the whole model, which it holds meanwhile."""
        whole = self.gathered(training=False)
        found = self._alone(lambda: work(SceneModel.from_checkpoint(given(whole), self.device)))
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        return found

    def _evaluate_whole(self) -> None:
        def judge(whole: SceneModel) -> None:
            with going_on_without(self.logger.say), self._as_model(whole):
                self.results.evaluate()

        self._alone_with_whole(judge)
        self._stop_if_wished()

    @contextmanager
    def _as_model(self, whole: SceneModel) -> Iterator[None]:
        """Around what judges or writes ``self.model``: let it be the whole one."""
        share, counts = self.model, self.state.counts
        self.model = self.state.model = whole
        sets = self.state.gaussian_sets
        self.state.gaussian_sets = {name: whole.gaussians(name) for name in whole.gaussian_sets}
        self.state.counts = None
        try:
            yield
        finally:
            self.model = self.state.model = share
            self.state.gaussian_sets, self.state.counts = sets, counts

    def gathered(self, *, training: bool) -> Checkpoint | None:
        """The checkpoint of all ranks together, on rank 0; with Adam's moments, or without."""
        own = self.state.checkpoint(self.asked, self.sh_degree, self.capture.scales, self.capture)
        return whole_checkpoint(self.team, self.state, own, training=training and not self.state.trimmed)

    def _save_meanwhile(self) -> None:
        """Begin to write a checkpoint while training goes on."""
        with self._gathering:
            whole = self.gathered(training=True)
            if whole is not None:
                with going_on_without(self.logger.say), self.checkpoints.beginning(self._file(), whole.state()):
                    pass

    def finish_writing(self) -> None:
        """Let a checkpoint that is under way come to its end; for other threads, when all are about to end."""
        if self._gathering.acquire(timeout=GATHERING):
            self._gathering.release()
        self.checkpoints.wait()

    def save(self) -> Path:
        """Write a checkpoint between two steps, by all ranks; the file."""
        return self._save()

    def _save(self) -> Path:
        self._stop_if_not_finite()
        return self._write()

    def _write(self) -> Path:
        whole = self.gathered(training=True)

        def write() -> Path:
            with naming_the_newest_checkpoint(self.run):
                return self.checkpoints.write_last(self.run, self._file(), given(whole).state())

        return self.team.object_of_first(self._alone(write, to_its_end=True))

    def _file(self) -> Path:
        return self.run.checkpoint(self.state.step)

    # ---- when it goes wrong ------------------------------------------------------------------------------------------

    def _stop_if_wished(self) -> None:
        """Save and stop where a signal was sent to any rank; hear whether rank 0 calls all ranks together."""
        of_ranks = self.team.numbers([self.wish.number, self.team.is_first and self.calls()])
        self.called = bool(of_ranks[0][1])
        numbers = [number for number, _ in of_ranks if number]
        if numbers:
            raise TrainingInterrupted(self._save(), self.run.resume_command(), numbers[0])

    def _stop_if_not_finite(self) -> None:
        found = self.team.objects(self.guard.first_bad())
        bad = [(entry, rank) for rank, entry in enumerate(found) if entry is not None]
        if not bad:
            return
        (bad_step, name), rank = min(bad)
        self.state.step = bad_step - 1  # the guard has kept every update since from being made, on all ranks
        saved = self._write()
        if not self.team.is_first:
            raise EndedElsewhere(2)
        suspects = "the poses of the capture"
        raise not_finite_error(bad_step, name, f"on rank {rank}", suspects, saved, self.run.resume_command())

    def _what_is_saved(self) -> str:
        """Of a rank that failed within a step: the state is in the memories of all, which make no calls any more."""
        latest = self.newest_checkpoint()
        return "No checkpoint is saved." if latest is None else f"The newest checkpoint that is saved: {latest}."

    def _out_of_memory(self) -> UserError:
        """What would need less memory."""
        numbers = map(self.state.num_gaussians, self.state.gaussian_sets)
        camera = next(iter(self.schedule.frame(self.state.step).views.values())).camera
        where = f"On rank {self.team.rank} of {self.team.size}, with a share of the Gaussians. {self._what_is_saved()}"
        size, resume = f"{camera.width}x{camera.height}", self.run.resume_command()
        step, scenes = self.state.step + 1, self._scenes_of_limit
        return out_of_memory_error(step, sum(numbers), size, self.device, where, resume, scenes=scenes)


def given(checkpoint: Checkpoint | None) -> Checkpoint:
    """What ``gathered`` gave, on rank 0, which alone has it."""
    if checkpoint is None:
        raise RuntimeError("Only rank 0 has the whole checkpoint.")
    return checkpoint
