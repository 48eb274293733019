"""Ctrl-C, SIGTERM and SIGHUP of a rank, which must not leave the others alone in the middle of a step."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from thermosplat.stop_signals import Stopped, handled_signals


class StopWish:
    """Whether somebody wants this rank to stop: the ranks ask each other after every step.

    Attributes:
        number: The signal; 0 where nobody does.
    """

    def __init__(self) -> None:
        self.number = 0
        self._at_once = False

    def note(self, number: int, frame: FrameType | None = None) -> None:
        """Take note of a signal; in a block that may end at any moment, end it."""
        self.number = number
        if self._at_once:
            raise Stopped(number)

    @contextmanager
    def heard_at_once(self) -> Iterator[None]:
        """Around work of one rank alone, which a signal may end in the middle."""
        self._at_once = True
        try:
            yield
        except Stopped:
            pass  # it is noted; all stop after this block
        finally:
            self._at_once = False


@contextmanager
def stop_wishes(wish: StopWish) -> Iterator[None]:
    """Let signals be noted in the block instead of raised.

    Args:
        wish: Where.
    """
    with handled_signals(wish.note):
        yield
