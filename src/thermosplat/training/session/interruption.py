"""A training that is stopped from outside, and work beside it that is not cut off."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from thermosplat.stop_signals import deferred_interrupts


class TrainingInterrupted(Exception):
    """The training was stopped from outside; everything up to then is in a checkpoint.

    Args:
        number: The signal that stopped it.
    """

    def __init__(self, checkpoint: Path, resume_command: str, number: int = signal.SIGINT) -> None:
        super().__init__(f"Interrupted. Checkpoint: {checkpoint}. Go on with: {resume_command}")
        self.checkpoint = checkpoint
        self.resume_command = resume_command
        self.number = number

    @property
    def exit_code(self) -> int:
        """What a shell expects of a program that a signal ended."""
        return 128 + self.number


@contextmanager
def meanwhile(work: Callable[[], object]) -> Iterator[None]:
    """Do something in another thread during a block. It is done when the block ends, however that ends.

    Args:
        work: What to do: something that the block does not disturb. What it raises is raised at the end of the block.
            It must not use a parameter that the block uses: a thread that derives a tensor from one locks it and then
            waits for the interpreter, which another thread at the same parameter holds while it waits for the lock
            (seen with PyTorch 2.13). Detached tensors have no such lock.
    """
    with ThreadPoolExecutor(max_workers=1) as thread:
        try:
            with deferred_interrupts():  # a thread that was interrupted while it was started would not be waited for
                working = thread.submit(work)
            yield
        finally:
            with deferred_interrupts():
                working.result()
