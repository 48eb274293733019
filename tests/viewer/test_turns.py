"""Renders between the steps of a training: in the thread that trains, and no more than their share of the time."""

import threading
import time
from collections.abc import Callable

import pytest

from thermosplat.viewer.turns import BetweenSteps, OneAtATime, ViewingEnded


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
    while not turns.waiting:
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
        results.append(turns.run(threading.get_ident))
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


def test_who_asked_first_is_next() -> None:
    """Who renders one picture after the other, as for a video, keeps nobody waiting for more than one of them."""
    turns, order = OneAtATime(), []
    begun = threading.Event()

    def first() -> None:
        begun.set()
        while len(turns.waiting) < 2:
            time.sleep(0.001)
        order.append("picture")

    def video() -> None:
        turns.run(first)
        for _ in range(9):
            turns.run(lambda: order.append("picture"))

    large = threading.Thread(target=video)
    large.start()
    assert begun.wait(60)
    turns.run(lambda: order.append("other"))
    large.join()
    assert order == ["picture", "other", *["picture"] * 9]


def test_who_waits_is_told_of_the_end() -> None:
    """Work that runs is done; what waits ends, and what fails has its own error."""
    turns = OneAtATime()
    with pytest.raises(ZeroDivisionError):
        turns.run(lambda: 1 / 0)
    told: list[str] = []

    def wait() -> None:
        try:
            turns.run(lambda: told.append("done"))
        except ViewingEnded:
            told.append("ended")

    def work() -> str:
        threading.Thread(target=wait).start()
        while len(turns.waiting) < 2:
            time.sleep(0.001)
        turns.end()
        while not told:
            time.sleep(0.001)
        return "work"

    assert turns.run(work) == "work"
    assert told == ["ended"]
    with pytest.raises(ViewingEnded):
        turns.run(lambda: None)
