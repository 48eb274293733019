"""Ctrl-C during training: at any moment, with nothing lost and no half-done update."""

import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType


class TrainingInterrupted(Exception):
    """The user stopped the training; everything up to then is in a checkpoint.

    Args:
        checkpoint: The checkpoint.
        resume_command: The command line that goes on from it.
    """

    def __init__(self, checkpoint: Path, resume_command: str) -> None:
        super().__init__(f"Interrupted. Checkpoint: {checkpoint}. Go on with: {resume_command}")
        self.checkpoint = checkpoint
        self.resume_command = resume_command


@contextmanager
def deferred_interrupts(redeliver: bool = True) -> Iterator[None]:
    """Let Ctrl-C wait until the block is done: for updates and files that must not stop half-way.

    Outside the main thread Python delivers no signals, and there is nothing to defer.

    Args:
        redeliver: Act on a Ctrl-C of the meantime afterwards. Off where the program is about to end anyway.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pending = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pending
        pending = True

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
    if pending and redeliver:
        signal.raise_signal(signal.SIGINT)  # to whoever listened before: KeyboardInterrupt, or the block around this


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
