"""The signals that stop a program: Ctrl-C (SIGINT), SIGTERM, and SIGHUP of a terminal that is closed.

SIGTERM is what a cluster's time limit, docker stop and timeout send.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_raised: list["Stopped"] = []
"""What a signal has raised in the present block of ``stopped_by_signals``."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C, SIGTERM or SIGHUP: ends what Ctrl-C ends."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def signal_of(stop: KeyboardInterrupt) -> signal.Signals:
    """The signal that an interrupt stands for."""
    return signal.Signals(getattr(stop, "number", signal.SIGINT))


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise ``Stopped`` in the block; at the last two Python would end at once.

    Who had a signal ignored keeps that (nohup). Importing pycolmap puts handlers of its own in their place, which print
    the C stack: begin the block again after that. A loop that must stop calls ``raise_lost_stop`` in every round.
    """
    _raised.clear()
    try:
        with handled_signals(_stop):
            yield
    finally:
        _raised.clear()


def raise_lost_stop() -> None:
    """Raise the ``Stopped`` that a signal raised in this block of ``stopped_by_signals``, if it came to nothing.

    Python may run a handler in the middle of C code, and C code that clears errors clears this one, too. CPython 3.11
    does so while ``os.fdopen`` opens a file.
    """
    if _raised:
        raise _raised[0]


@contextmanager
def handled_signals(
    handler: Callable[[int, FrameType | None], object] | signal.Handlers,
) -> Iterator[None]:
    """Let a handler have the stop signals in the block, but for those that are ignored.

    Nothing is done outside the main thread, which alone hears signals.

    Args:
        handler: As of ``signal.signal``: called by Python with the signal's number, or ``SIG_DFL``.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
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
    numbers = [number for number in STOP_SIGNALS if callable(signal.getsignal(number))]
    previous = {number: signal.signal(number, note) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if pending and redeliver:
        signal.raise_signal(pending[0])  # to whoever listened before: an exception, or the block around this


@contextmanager
def held_stop_signals() -> Iterator[None]:
    """Hold the stop signals back from this thread, and from the processes that it forks in the block.

    This thread hears afterwards what came meanwhile. A forked process hears what came once it unblocks
    ``STOP_SIGNALS``, so no handler that it has inherited runs before it has set its own.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
