"""Progress of the steps."""

import pytest

from thermosplat.prepare.progress import progress_bar, tracked


def test_items_are_passed_on_in_silence(capsys: pytest.CaptureFixture[str]) -> None:
    """All of them in their order; where there is no terminal, nothing is printed."""
    assert list(tracked(iter("abc"), "letters", 3)) == ["a", "b", "c"]
    with progress_bar("parts", 2) as advance:
        advance(2)
    assert capsys.readouterr() == ("", "")
