"""Ctrl-C and its like during training: at any moment, with nothing lost and no half-done update.

SIGTERM (a cluster's time limit, docker stop, timeout), SIGHUP (a terminal that is closed) and an output that nobody
reads any more (``| head``) stop a training as Ctrl-C does.
"""

import errno
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_raised: list["Stopped"] = []
"""What a signal has raised in the present block of ``stop_signals``."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C, SIGTERM or SIGHUP: ends what Ctrl-C ends.

    Args:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class TrainingInterrupted(Exception):
    """The training was stopped from outside; everything up to then is in a checkpoint.

    Args:
        checkpoint: The checkpoint.
        resume_command: The command line that goes on from it.
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


def stop_signal(error: BaseException) -> signal.Signals | None:
    """The signal that an exception stands for: SIGPIPE where nobody reads the output; None for any other error."""
    if isinstance(error, KeyboardInterrupt):
        return signal.Signals(getattr(error, "number", signal.SIGINT))
    if isinstance(error, OSError) and error.errno in (errno.EPIPE, errno.EIO):  # EIO: the terminal was closed
        return signal.SIGPIPE
    return None


@contextmanager
def stop_signals() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise ``Stopped`` in the block; at the last two Python would end at once.

    Who had a signal ignored keeps that (nohup). Importing pycolmap puts handlers of its own in their place, which print
    the C stack: begin the block again after that. A loop that must stop calls ``hear_lost_stop`` in every round.
    """
    _raised.clear()
    try:
        with handled_signals(_STOPPING, _stop):
            yield
    finally:
        _raised.clear()


def hear_lost_stop() -> None:
    """Raise the ``Stopped`` that a signal raised in this block of ``stop_signals``, if it came to nothing.

    Python may run a handler in the middle of C code, and C code that clears errors clears this one, too. CPython 3.11
    does so while ``os.fdopen`` opens a file.
    """
    if _raised:
        raise _raised[0]


@contextmanager
def handled_signals(
    numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]
) -> Iterator[None]:
    """Let a handler have signals in the block, but for those that are ignored; nothing is done outside the main thread.

    Args:
        numbers: The signals.
        handler: Called by Python with the signal's number, as of ``signal.signal``.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)


def _stop(number: int, frame: FrameType | None) -> None:
    _raised[:] = [Stopped(number)]
    raise _raised[0]


@contextmanager
def deferred_interrupts(redeliver: bool = True) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP wait until the block is done: for what must not stop half-way.

    Outside the main thread Python delivers no signals, and there is nothing to defer.

    Args:
        redeliver: Act on a signal of the meantime afterwards. Off where the program is about to end anyway.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pending: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        pending.append(number)

    # those that Python acts on; what else would be done is done at once
    numbers = [number for number in _STOPPING if callable(signal.getsignal(number))]
    previous = {number: signal.signal(number, note) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if pending and redeliver:
        signal.raise_signal(pending[0])  # to whoever listened before: an exception, or the block around this


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
