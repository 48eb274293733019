"""``thermosplat-train`` as one of several ranks, which torchrun or ``--devices`` started.

Rank 0 understands the command line, speaks and writes. What goes wrong on a rank is said once, and ends all of them.
"""

import contextlib
import io
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.errors import print_error, run_command
from thermosplat.cli.flag_values import last_value
from thermosplat.cli.host_settings import importing, prepare_host
from thermosplat.cli.training.beginning import capture_and_trainer, check_capture_to_go_on_with
from thermosplat.cli.training.devices import GRACE, PARENT
from thermosplat.cli.training.ending import say_what_and_where
from thermosplat.cli.viewer_flags import viewer_flags
from thermosplat.config.files import data_from_anywhere
from thermosplat.distributed.lifeline import Lifeline
from thermosplat.distributed.team import EndedElsewhere, Team
from thermosplat.errors import UserError
from thermosplat.printing import print_last, safe_output

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig
    from thermosplat.datasets.capture import Capture
    from thermosplat.runs.run_directory import RunDirectory
    from thermosplat.training.trainer import Trainer

_POLL = 0.5
"""Between looks at whether the parent lives [s]."""
_SHOWN_CAUSE = 200
"""Letters of a library's message that are shown."""
FIRST_WORD = 1.0
"""What another rank leaves rank 0 to tell the user of what all have met [s]."""


class RankOfTraining:
    """One rank's part of a training."""

    def __init__(self, argv: list[str]) -> None:
        self.argv = argv
        self.lifeline: Lifeline | None = None
        self.run: RunDirectory | None = None
        self.finish_writing: Callable[[], None] | None = None
        """On rank 0: lets the checkpoint that is under way come to its end."""
        self.agreed = False
        """Whether all ranks know that they end, and another one may still have to say why."""

    def main(self) -> int:
        """Train with the other ranks; the exit code."""
        _end_with_the_parent()
        with safe_output():
            try:
                code = run_command(self._train, debug="--debug" in self.argv)
            except Exception:
                time.sleep(FIRST_WORD)  # an exchange that broke as another rank died: the lifeline tells of that
                traceback.print_exc()
                print_error("This rank failed, and the training ended with it.", self._how_to_go_on())
                code = 1
            if self.lifeline is not None:
                if code and not self.agreed:
                    self.lifeline.failed(code)
                else:
                    self.lifeline.done()
        os._exit(code)  # other threads wait for ranks that may not answer any more

    def _train(self) -> int:
        prepare_host()
        with importing():
            from thermosplat.distributed.joining import join_team

        try:
            team = join_team(last_value(self.argv, "--device") or "auto")
            self.lifeline = Lifeline(team, self._tell_death)
        except (RuntimeError, OSError) as error:
            cause = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UserError(
                f"The ranks did not meet: one ended, or cannot be reached ({cause[:_SHOWN_CAUSE]}).",
                "Nothing was trained yet: start it again. Hosts must reach each other at any port.",
            ) from error
        silence = contextlib.nullcontext() if team.is_first else contextlib.redirect_stdout(io.StringIO())
        with silence:
            try:
                return self._train_in(team)
            except UserError:
                if not team.is_first:  # where rank 0 failed likewise, it says so and ends this one meanwhile
                    time.sleep(FIRST_WORD + 0.2 * min(team.rank, 10))
                raise
            except EndedElsewhere as end:
                self.agreed = True
                return end.code
            except KeyboardInterrupt:
                if team.is_first:
                    raise
                return 130

    def _train_in(self, team: Team) -> int:
        config = team.asked_of_first(lambda: parse_train_arguments(self.argv))
        asked, capture = team.done_by_all(lambda: self._capture(config))
        config = team.asked_of_first(lambda: asked)
        with importing():
            from thermosplat.cli.training.watched_training import watched_by_first
            from thermosplat.stop_signals import stopped_by_signals
            from thermosplat.training.session.interruption import TrainingInterrupted
            from thermosplat.training.sharing.same_capture import check_same_capture

        check_same_capture(team, capture)
        trainer = self._trainer(team, config, capture)
        self.run = trainer.run
        trainer.keeping.newest_checkpoint = self._newest_checkpoint
        if self.lifeline is not None and team.is_first:
            self.finish_writing = trainer.keeping.finish_writing
            self.lifeline.before_end = trainer.keeping.finish_writing
            self.lifeline.answer = lambda: str(self._newest_checkpoint() or "")
        try:
            with stopped_by_signals(), watched_by_first(trainer, viewer_flags(self.argv)):
                metrics = trainer.train()
        except TrainingInterrupted as stop:
            self.agreed = True
            if team.is_first:
                print_last(
                    f"Stopped at step {trainer.step:,}; saved {stop.checkpoint}.", f"Go on with: {stop.resume_command}"
                )
            return stop.exit_code
        if team.is_first:
            say_what_and_where(trainer, metrics)
        return 0

    def _trainer(self, team: Team, config: "TrainConfig", capture: "Capture") -> "Trainer":
        from thermosplat.runs.run_directory import RunDirectory
        from thermosplat.training.trainer import Trainer

        devices = team.size if PARENT in os.environ else 1  # of torchrun nobody knows how it was started
        if config.resume is not None:
            run = RunDirectory(config.resume, devices)
            # a run of one process from before there were batches has steps of one frame
            kept = replace(config, data=data_from_anywhere(config.data), resume=None, batch_size=config.batch_size or 1)
            return Trainer.resume(kept, capture, run, team=team)
        folder = config.result_dir or str(Path("results") / capture.name / Path(config.config).stem)
        kept = replace(
            config,
            data=data_from_anywhere(config.data),
            result_dir=folder,
            overwrite=False,
            batch_size=config.batch_size or team.size,
        )
        trainer = Trainer(kept, capture, RunDirectory(folder, devices), team=team)

        def create() -> None:  # last, as it may delete here
            RunDirectory.create(folder, overwrite=config.overwrite)

        team.asked_of_first(create)
        return trainer

    def _capture(self, config: "TrainConfig") -> tuple["TrainConfig", "Capture"]:
        if config.resume is not None:
            check_capture_to_go_on_with(config)
        return capture_and_trainer(self.argv, config)[:2]

    def _tell_death(self, name: str) -> None:
        """Say that another rank died; called by the thread that noticed."""
        print_error(
            f"{name} ended without a word: it was killed, or it crashed. The training ended with it.",
            self._how_to_go_on(),
        )

    def _how_to_go_on(self) -> str:
        if self.run is None:
            return "Nothing was trained yet: start it again."
        latest, resume = self._newest_checkpoint(), self.run.resume_command()
        if latest is not None:
            return f"The newest checkpoint that is saved: {latest}. Go on with: {resume}"
        if not self.run.path.is_dir():
            return f"Its checkpoints are in {self.run.path} on the host of rank 0. Go on with: {resume}"
        return f"No checkpoint is saved in {self.run.path}: start it again, with --save-steps for the next time."

    def _newest_checkpoint(self) -> Path | None:
        """The newest one, as rank 0 says, which writes them; as it looks from here where rank 0 is dead."""
        if self.run is None:
            return None
        if self.finish_writing is None and self.lifeline is not None:
            answer = self.lifeline.asked_of_first()
            if answer is not None:
                return Path(answer) if answer else None
        if self.finish_writing is not None:
            self.finish_writing()
        return self.run.latest_checkpoint() if self.run.ckpts.is_dir() else None


def _end_with_the_parent() -> None:
    """Of a process that ``--devices`` started: stop where that one is killed."""
    parent = os.environ.get(PARENT)
    if parent is None:
        return

    def watch() -> None:
        while os.getppid() == int(parent):
            time.sleep(_POLL)
        os.kill(os.getpid(), signal.SIGTERM)  # save what there is, if Python can act on it
        time.sleep(GRACE)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
