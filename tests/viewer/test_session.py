"""Sessions render what is missing and no more; turns and pace keep to their shares."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from thermosplat.viewer.layers import Layer
from thermosplat.viewer.pace import LEAST_PIXELS, Pace
from thermosplat.viewer.session import Wish
from thermosplat.viewer.turns import BetweenSteps, ViewingEnded
from viewed_toy import moved, toy_session, viewed_toy


def test_only_what_is_missing_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another palette or another edge of the wipe renders nothing; another view or size does."""
    session = toy_session(viewed_toy())
    asked: list[list[Layer]] = []
    render = session.renderer.render
    monkeypatch.setattr(
        session.renderer, "render", lambda layers, *a, **k: asked.append(list(layers)) or render(layers, *a, **k)
    )
    rgb, thermal = Layer("image", "rgb"), Layer("image", "thermal")
    start = session.renderer.scene.start()
    session.render(start, 24, 18)
    session.wish = Wish(rgb, thermal, "wipe", 0.3)
    first = session.render(start, 24, 18)
    session.wish = dataclasses.replace(session.wish, share=0.6)
    session.set_display(thermal, palette="viridis")
    second = session.render(start, 24, 18)
    assert asked == [[rgb], [thermal]]
    assert (first.picture != second.picture).any()
    session.render(start, 30, 18)
    session.render(moved(start, 0.1), 30, 18)
    session.forget_picture()
    session.render(moved(start, 0.1), 30, 18)
    assert asked[2:] == [[rgb, thermal]] * 3


def test_the_photograph_lies_over_the_render() -> None:
    """Where the photograph is, the picture is the photograph's."""
    session = toy_session(viewed_toy())
    frame = session.renderer.scene.frames[1]
    start = dataclasses.replace(session.renderer.scene.start(), viewmat=frame.views["rgb"].viewmat)
    plain = session.render(start, 24, 18).picture
    session.wish = dataclasses.replace(session.wish, over=True)
    over = session.render(start, 24, 18).picture
    session.wish = Wish(Layer("photograph", "rgb"), Layer("photograph", "rgb"))
    photograph = session.render(start, 24, 18).picture
    there = (photograph > 0).any(axis=-1)
    assert there.mean() > 0.5
    np.testing.assert_array_equal(over[there], photograph[there])
    assert (over != plain).any()


def test_a_moving_picture_gets_the_size_that_its_machine_can() -> None:
    """The number of pixels approaches what takes the target's time, whether that is more or fewer."""
    for seconds_per_pixel in (5e-8, 5e-6):
        pace = Pace(target=0.1)
        for _ in range(20):
            width, height = pace.size(1280, 720)
            pace.took(width, height, 0.01 + seconds_per_pixel * width * height)
        width, height = pace.size(1280, 720)
        if seconds_per_pixel == 5e-8:
            assert (width, height) == (1280, 720)
        else:
            assert 0.07 < 0.01 + seconds_per_pixel * width * height < 0.13
        assert width / height == pytest.approx(16 / 9, rel=0.05)
    assert pace.seconds(*pace.size(1280, 720)) == pytest.approx(0.1, rel=0.4)
    assert pace.seconds(1280, 720) > 1.0
    slow = Pace()
    assert slow.seconds(1280, 720) == 0
    for _ in range(20):
        slow.took(*slow.size(1280, 720), 10.0)
    assert slow.pixels == pytest.approx(LEAST_PIXELS, rel=0.01)


def test_renders_take_their_share_of_training() -> None:
    """However much is asked for, turns between steps take 5% of the time, give or take one turn."""
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
    assert sum(spent[:-1]) <= 0.05 * 0.8 + 0.002


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
