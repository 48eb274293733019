"""What the ranks of a training tell each other between its steps, and what rank 0 does while the others wait.

Ctrl-C, SIGTERM and SIGHUP must not leave the other ranks alone in the middle of a step: each rank takes note of its
signals, and after every step all hear of them. Of a team of one they are raised where they come.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any

from thermosplat.distributed.team import Team
from thermosplat.stop_signals import Stopped, handled_signals


class Meetings:
    """Meetings of the ranks of a training.

    Attributes:
        signal: What this rank was sent; 0 for none.
        calls: On rank 0: whether all ranks are to come together after the step.
        called: Whether rank 0 has called all ranks together: ``between_steps`` of all of them is where they meet.
    """

    def __init__(self, team: Team) -> None:
        self.team = team
        self.signal = 0
        self.calls: Callable[[], bool] = lambda: False
        self.called = False
        self._at_once = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Around a training: of several ranks, let signals be noted instead of raised."""
        with nullcontext() if self.team.is_alone else handled_signals(self.note):
            yield

    def note(self, number: int, frame: FrameType | None = None) -> None:
        """Take note of a signal; in a block that may end at any moment, end it."""
        self.signal = number
        if self._at_once:
            raise Stopped(number)

    def signal_to_any(self) -> int:
        """The signal that some rank was sent, 0 for none; hear whether rank 0 calls all ranks together."""
        if self.team.is_alone:
            return 0
        of_ranks = self.team.numbers([self.signal, self.team.is_first and self.calls()])
        self.called = bool(of_ranks[0][1])
        return next((number for number, _ in of_ranks if number), 0)

    def by_first(self, work: Callable[[], Any], *, to_its_end: bool = False) -> Any:
        """Let rank 0 do something while the others wait; what it gives, None on the others.

        Args:
            to_its_end: A signal waits until it is done, rather than end it.
        """
        if self.team.is_alone:
            return work()
        held: list[Any] = []

        def done() -> None:
            with nullcontext() if to_its_end else self._heard_at_once():
                held.append(work())

        self.team.asked_of_first(done)
        return held[0] if held else None

    @contextmanager
    def _heard_at_once(self) -> Iterator[None]:
        """Around work of one rank alone, which a signal may end in the middle."""
        self._at_once = True
        try:
            yield
        except Stopped:
            pass  # it is noted; all stop after this block
        finally:
            self._at_once = False
