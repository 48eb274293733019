"""Renders between the steps of a training: in the thread that trains, and no more than their share of the time."""

import threading
import time

import pytest

from thermosplat.viewer.turns import BetweenSteps, ViewingEnded


def test_renders_take_their_share_of_training() -> None:
    """However much is asked for, turns between steps take 5% of the time, but for the first two and the last one."""
    turns = BetweenSteps(share=0.05)
    stop = threading.Event()
    spent: list[float] = []

    def work() -> None:
        started = time.perf_counter()
        time.sleep(0.004)
        spent.append(time.perf_counter() - started)

    def viewer() -> None:
        while not stop.is_set():
            try:
                turns.run(work)
            except ViewingEnded:
                return

    thread = threading.Thread(target=viewer)
    thread.start()
    started = time.perf_counter()
    while time.perf_counter() - started < 0.8:
        time.sleep(0.001)  # a step
        turns.take()
    stop.set()
    turns.end()
    thread.join(5)
    assert not thread.is_alive()
    assert len(spent) >= 3
    assert sum(spent[2:-1]) <= 0.05 * 0.8 + 0.002


def test_one_long_turn_is_not_paid_for() -> None:
    """A turn that loads kernels is no reason to show nothing for half a minute; long turns that follow it are."""
    turns = BetweenSteps(share=0.05)

    def pause_after(seconds: float) -> float:
        thread = threading.Thread(target=turns.run, args=(lambda: time.sleep(seconds),))
        started = time.perf_counter()
        thread.start()
        while thread.is_alive():
            turns.take()
            time.sleep(0.0005)
        return time.perf_counter() - started - seconds

    for seconds in (0.3, 0.002, 0.002, 0.002):
        pause_after(seconds)
    assert pause_after(0.2) < 0.2  # the pause for 2 ms, 38 ms
    assert pause_after(0.002) < 0.2
    for _ in range(2):
        pause_after(0.04)
    assert pause_after(0.002) > 0.3  # the pause for 40 ms, 760 ms


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
