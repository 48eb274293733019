"""Sessions render what is missing and no more."""

import dataclasses

import numpy as np
import pytest

from thermosplat.viewer.layers import Layer
from thermosplat.viewer.session import Unwanted
from thermosplat.viewer.turns import ViewingEnded
from thermosplat.viewer.wish import Wish
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


@pytest.mark.parametrize("renders", [0, 1])
def test_a_picture_that_nobody_wants_any_more_is_given_up(renders: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """When its turn comes, and when it is made too late; the picture before stays."""
    session = toy_session(viewed_toy())
    before = session.render(session.renderer.scene.start(), 24, 18)
    made: list[object] = []
    render = session.renderer.render
    monkeypatch.setattr(session.renderer, "render", lambda *a, **k: made.append(a) or render(*a, **k))
    with pytest.raises(Unwanted):
        session.render(session.renderer.scene.start(), 48, 36, unwanted=lambda: len(made) == renders)
    assert len(made) == renders
    assert session.shown is before


def test_a_viewer_aside_sees_the_same_and_leaves_with_the_first() -> None:
    """Its measurements and displays are its own."""
    session = toy_session(viewed_toy())
    aside = session.aside()
    aside.set_display(Layer("image", "thermal"), palette="viridis")
    assert not session.displays
    session.gone.set()
    with pytest.raises(ViewingEnded):
        aside.render(session.renderer.scene.start(), 24, 18)
