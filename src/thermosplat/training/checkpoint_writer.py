"""The checkpoints of a run, one at a time: written at once, or in another thread while training goes on.

A write that is under way holds a copy of the state in the host's memory, and nothing on the device.
"""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from thermosplat.checkpoint import on_host, save_checkpoint
from thermosplat.training.interruption import deferred_interrupts


class CheckpointWriter:
    """Writes checkpoints so that no two are written at a time and no failure is forgotten.

    What went wrong with a checkpoint that was written beside the training is raised once, by the next call.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._writing: Future[Path] | None = None

    @contextmanager
    def beginning(self, path: Path, state: dict[str, Any]) -> Iterator[None]:
        """Around what leaves the state as it is: begin to write a checkpoint that is completed while training goes on.

        When the block ends, everything lies in the host's memory: training changes tensors in place.

        Args:
            path: The file.
            state: Its content; no parameters (``meanwhile`` says why).

        Raises:
            UserError: If the one before could not be written.
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

        Args:
            path: The file.
            state: Its content, which nobody changes meanwhile.

        Raises:
            UserError: If this one could not be written, or the one that was under way.
        """
        with deferred_interrupts():
            try:
                self.wait()
            finally:
                save_checkpoint(path, state)
        return path

    def look(self) -> None:
        """Raise what went wrong with a write that has ended, without waiting for one that has not."""
        if self._writing is not None and self._writing.done():
            self.wait()

    def wait(self) -> None:
        """Let the write that is under way come to its end, and raise what went wrong with it."""
        with deferred_interrupts():
            writing, self._writing = self._writing, None
            if writing is not None:
                writing.result()
