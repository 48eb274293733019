"""Renders between the steps of a training: in the thread that trains, and no more than their share of the time."""

import threading
import time
from collections.abc import Callable

import pytest

from thermosplat.viewer.turns import BetweenSteps, ViewingEnded


class Clock:
    """A clock that goes on when it is told to: the machine may be as busy as it likes."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def work(self, seconds: float) -> None:
        """Be busy for so long."""
        self.now += seconds


def ask(turns: BetweenSteps, work: Callable[[], None]) -> threading.Thread:
    """A viewer that waits for its turn."""
    thread = threading.Thread(target=turns.run, args=(work,))
    thread.start()
    while not turns._waiting:
        time.sleep(0.001)
    return thread


def pause_after(turns: BetweenSteps, clock: Clock, seconds: float) -> float:
    """How long a viewer waits for a turn that lasts some seconds, between steps of a millisecond [s]."""
    lasted: list[float] = []
    thread = ask(turns, lambda: lasted.append(clock.now) or clock.work(seconds))
    asked = clock.now
    while not lasted:
        clock.work(0.001)
        turns.take()
    thread.join()
    return lasted[0] - asked


def test_renders_take_their_share_of_training() -> None:
    """However much is asked for, turns between steps take 5% of the time, once two have said how long they last."""
    clock = Clock()
    turns = BetweenSteps(share=0.05, clock=clock)
    for _ in range(2):
        pause_after(turns, clock, 0.004)
    begin = clock.now
    waited = [pause_after(turns, clock, 0.004) for _ in range(20)]
    assert clock.now - begin == pytest.approx(20 * 0.004 / 0.05, rel=0.05)
    assert waited[-1] == pytest.approx(0.076, abs=0.0011)


def test_one_long_turn_is_not_paid_for() -> None:
    """A turn that loads kernels is no reason to show nothing for half a minute; long turns that follow it are."""
    clock = Clock()
    turns = BetweenSteps(share=0.05, clock=clock)
    for seconds in (0.3, 0.002, 0.002, 0.002):
        pause_after(turns, clock, seconds)
    assert pause_after(turns, clock, 0.2) < 0.04  # the pause for 2 ms, 38 ms
    assert pause_after(turns, clock, 0.002) < 0.04
    for _ in range(2):
        pause_after(turns, clock, 0.04)
    assert pause_after(turns, clock, 0.002) == pytest.approx(0.76, abs=0.0011)  # the pause for 40 ms


def test_work_runs_between_steps_in_the_thread_that_trains() -> None:
    """The work's thread, its result and its error are right; after the end there are no turns."""
    turns = BetweenSteps()
    results: list[object] = []

    def ask() -> None:
        results.extend(turns.run(threading.get_ident))
        try:
            turns.run(lambda: 1 / 0)
        except ZeroDivisionError as error:
            results.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    turns.take_until(lambda: len(results) == 2)
    thread.join(5)
    assert results[0] == threading.get_ident()
    assert isinstance(results[1], ZeroDivisionError)
    turns.end()
    with pytest.raises(ViewingEnded):
        turns.run(lambda: None)
