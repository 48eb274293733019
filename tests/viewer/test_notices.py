"""Lines on the terminal: one each, few, and nothing in them that a terminal obeys."""

import logging

import pytest

from thermosplat.viewer.notices import AT_ONCE, SECONDS, Notices


def test_lines_come_at_a_bounded_pace(capsys: pytest.CaptureFixture[str]) -> None:
    """A flood gives the first few; the next one later says how many were left out."""
    now = [1000.0]
    notices = Notices(clock=lambda: now[0])
    for _ in range(1000):
        notices.say("a request was refused")
    assert capsys.readouterr().err.count("\n") == AT_ONCE
    now[0] += SECONDS
    notices.say("a request was refused")
    assert capsys.readouterr().err == f"Viewer: a request was refused (and {1000 - AT_ONCE} like it before)\n"
    now[0] += 1000 * SECONDS
    for _ in range(100):
        notices.say("again")
    assert capsys.readouterr().err.count("\n") == AT_ONCE


def test_a_line_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Line ends, escapes and other letters are shown, not obeyed; a logger's traceback is left out."""
    notices = Notices()
    notices.say("a\nb\r\x1b[31m\u202e" + "x" * 10_000)
    logger = logging.Logger("test")
    logger.addHandler(notices)
    try:
        raise ValueError("two\nlines")
    except ValueError:
        logger.exception("failed")
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("Viewer: a b \\x1b[31m\\u202exxx")
    assert len(said[0]) < 400
    assert said[1:] == ["Viewer: failed: ValueError: two lines"]
