"""The checkpoints of a run, one at a time: written at once, or in another thread while training goes on.

A write that is under way holds a copy of the state in the host's memory, and nothing on the device. A disk that is full
while training goes on is said and no more: the state is in memory, and space may be free at the next step that saves.
"""

import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import NotWrittenError
from thermosplat.runs.checkpoint_file import num_stored_bytes, on_host, save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.stop_signals import deferred_interrupts


class CheckpointWriter:
    """Writes checkpoints so that no two are written at a time and no failure is forgotten.

    That a checkpoint beside the training could not be written is said once, by the next call; anything else that went
    wrong with it is raised there.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._writing: Future[Path] | None = None

    @contextmanager
    def beginning(self, path: Path, state: dict[str, Any]) -> Iterator[None]:
        """Around what leaves the state as it is: begin to write a checkpoint that is completed while training goes on.

        When the block ends, everything lies in the host's memory: training changes tensors in place.

        Args:
            state: Its content; no parameters (``meanwhile`` says why).
        """
        with deferred_interrupts():  # a thread that was interrupted while it was started would not be waited for
            self.wait()
            gathering = self._thread.submit(on_host, state)
            self._writing = self._thread.submit(lambda: save_checkpoint(path, gathering.result()))
        try:
            yield
        finally:
            with deferred_interrupts():
                wait([gathering])  # what goes wrong with it goes wrong with the writing

    def write(self, path: Path, state: dict[str, Any]) -> Path:
        """Write a checkpoint at once, after the one that is under way and whatever became of that.

        Raises:
            NotWrittenError: If this one could not be written.
        """
        with deferred_interrupts():
            try:
                self.wait()
            finally:
                save_checkpoint(path, state)
        return path

    def write_last(self, run: RunDirectory, path: Path, state: dict[str, Any]) -> Path:
        """As ``write``, of the last checkpoint of a training: on a full disk older ones make room for it.

        The oldest goes first. The newest stays, from which the run could go on. Where all others together do not make
        enough room, none goes.

        Raises:
            NotWrittenError: If it could not be written.
        """
        older = [file for file in run.checkpoints() if file != path][:-1]
        needed = num_stored_bytes(state)
        while True:
            try:
                return self.write(path, state)
            except NotWrittenError as error:
                room = shutil.disk_usage(run.ckpts).free + sum(file.stat().st_size for file in older)
                if not error.disk_is_full or not older or room < needed:
                    raise
                oldest = older.pop(0)
                oldest.unlink(missing_ok=True)
                self._say(f"The disk is full: {oldest} was deleted to make room for {path.name}.")

    def tell_failure(self) -> None:
        """Tell what went wrong with a write that has ended, without waiting for one that has not."""
        if self._writing is not None and self._writing.done():
            self.wait()

    def wait(self) -> None:
        """Let the write that is under way come to its end, and tell what went wrong with it."""
        with deferred_interrupts():
            writing, self._writing = self._writing, None
            if writing is not None:
                with going_on_without(self._say):
                    writing.result()


@contextmanager
def going_on_without(say: Callable[[str], None]) -> Iterator[None]:
    """Around files that a training can do without: say that one could not be written, and go on."""
    try:
        yield
    except NotWrittenError as error:
        say(f"{error.message} Training goes on without it.")


@contextmanager
def naming_the_newest_checkpoint(run: RunDirectory) -> Iterator[None]:
    """Around the last files of a training: where one cannot be written, say what there is to go on from.

    Raises:
        UserError: In place of a NotWrittenError.
    """
    try:
        yield
    except NotWrittenError as error:
        latest = run.latest_checkpoint()
        if latest is None:
            raise UserError(f"{error.message} No checkpoint of this training is saved.", error.hint) from error
        message = f"{error.message} The newest checkpoint that is saved: {latest}."
        raise UserError(message, f"Free some space, then go on with: {run.resume_command()}") from error
