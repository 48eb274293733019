"""How far the fit is, where the output is no terminal."""

from collections.abc import Iterator

import pytest

from thermosplat.cli.exporting.splats import shown_steps


def test_lines_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    """A line every ten seconds says how many steps are done; all steps are passed on, in order."""
    clock: Iterator[float] = iter(0.5 * place for place in range(1000))
    assert list(shown_steps(range(60), "thermal", clock=lambda: next(clock))) == list(range(60))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Fitting thermal: step 19 of 60 after 10")
    assert 2 <= len(lines) <= 3


def test_quick_fits_say_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """What is over before the first line is due prints none."""
    assert list(shown_steps(range(5), "rgb", clock=lambda: 3.0)) == [0, 1, 2, 3, 4]
    assert capsys.readouterr().out == ""
