"""Who may use the model now: renders take turns, and a model that is being trained is rendered between two steps."""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from statistics import median_low
from typing import Any, Protocol, TypeVar

Result = TypeVar("Result")
TRAINING_SHARE = 0.02
"""Share of the time of training that renders for viewers may take. What a viewer costs in all is more, such as the wait
for steps that a GPU has in its queue: with 0.05 about 8%. At most 5% are to be lost (benchmarks/records/viewer.md)."""
REMEMBERED = 5
"""Turns whose median says how long one takes."""


class Turns(Protocol):
    """Lets work with the model be done, one piece at a time."""

    def run(self, work: Callable[[], Result]) -> Result:
        """Do work when it may be done, and wait for it.

        Args:
            work: What renders; it runs in this or another thread.

        Raises:
            ViewingEnded: Nothing can be rendered any more.
        """

    def end(self) -> None:
        """No more turns: who waits for one is told so."""


class ViewingEnded(Exception):
    """The model is no longer there to be rendered, or nobody is there who would see it."""


class OneAtATime:
    """Turns at a model that nobody changes: each in the thread that asks, in the order in which they ask."""

    def __init__(self) -> None:
        self.waiting: deque[object] = deque()
        self._news = threading.Condition()
        self._ended = False

    def run(self, work: Callable[[], Result]) -> Result:
        """Do work when all is done that was asked for before."""
        mine = object()
        with self._news:
            self.waiting.append(mine)
        try:
            with self._news:
                self._news.wait_for(lambda: self._ended or self.waiting[0] is mine)
                if self._ended:
                    raise ViewingEnded
            return work()
        finally:
            with self._news:
                self.waiting.remove(mine)
                self._news.notify_all()

    def end(self) -> None:
        """No more turns: who waits for one is told so."""
        with self._news:
            self._ended = True
            self._news.notify_all()


class BetweenSteps:
    """Turns at a model that is trained: the thread that trains takes them between its steps.

    They take at most a share of the time that passes: each is paid for by a pause after it. A turn that takes much
    longer than those around it loads kernels, as the first one of a layer does, and nobody should see the same picture
    for half a minute because of that. So a pause is as long as the median of the last turns asks for.

    Args:
        share: Of the time, for all turns together; 1 where nothing waits for them.
        clock: What tells the time [s].

    Attributes:
        waiting: What is asked for and not begun, and what will hold its result.
    """

    def __init__(self, share: float = TRAINING_SHARE, clock: Callable[[], float] = time.perf_counter) -> None:
        self.share = share
        self._clock = clock
        self.waiting: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._arrived = threading.Condition()
        self._ended = False
        self._next = 0.0
        self._lasted = deque([0.0] * (REMEMBERED // 2), maxlen=REMEMBERED)
        """The last turns [s]."""

    def run(self, work: Callable[[], Result]) -> Result:
        """Let the thread that trains do the work."""
        done: Future[Result] = Future()
        with self._arrived:
            if self._ended:
                raise ViewingEnded
            self.waiting.append((work, done))
            self._arrived.notify_all()
        return done.result()

    def take(self) -> None:
        """Between two steps: do one waiting piece of work, if the share allows it now."""
        if self.waiting and self._clock() >= self._next:
            self._take_one()

    def take_until(self, until: Callable[[], bool]) -> None:
        """While training pauses: do what is waiting as it comes, until something is true.

        Args:
            until: Asked after each piece of work, and ten times a second.
        """
        while not until():
            with self._arrived:
                self._arrived.wait_for(lambda: bool(self.waiting), timeout=0.1)
            self._take_one()

    def wake(self) -> None:
        """Let ``take_until`` ask again at once."""
        with self._arrived:
            self._arrived.notify_all()

    def end(self) -> None:
        """No more turns: who waits for one is told so."""
        with self._arrived:
            self._ended = True
            left, self.waiting = self.waiting, deque()
        for _, done in left:
            done.set_exception(ViewingEnded())

    def _take_one(self) -> None:
        try:
            work, done = self.waiting.popleft()
        except IndexError:
            return
        started = self._clock()
        try:
            done.set_result(work())
        except Exception as error:
            done.set_exception(error)
        except BaseException:  # Ctrl-C: nothing is rendered any more
            done.set_exception(ViewingEnded())
            raise
        finally:
            now = self._clock()
            self._lasted.append(now - started)
            self._next = now + median_low(self._lasted) * (1 / self.share - 1)
