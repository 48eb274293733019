"""Who watches on rank 0 sees the scene of all ranks, and what is asked there all of them do; nothing hangs."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import watched_divided_runs as work
from ranks import Ranks
from thermosplat.runs.run_directory import RunDirectory


def test_a_paused_training_shows_the_whole_scene_steps_and_saves(ranks: Ranks, tmp_path: Path) -> None:
    """The picture is one process's of the same step, and that of the checkpoint; all ranks pause and go on."""
    first, second = ranks.run(work.watched, 2, str(tmp_path / "run"), "pauses_and_steps")
    assert first["end"] == second["end"] == (0, "")
    assert first["step"] == second["step"] == work.STEPS
    assert min(first["longest"], second["longest"]) > work.PAUSE
    assert (first["pictures"][1] != first["pictures"][2]).any()
    seen = first["pictures"][2].astype(int)
    np.testing.assert_array_equal(seen, work.picture_of(RunDirectory(tmp_path / "run").checkpoint(2)))
    assert np.abs(seen - work.picture_alone(str(tmp_path / "alone"), 2)).max() <= 1  # rounded to 8 bits


def test_renders_between_steps_change_no_digit(ranks: Ranks, tmp_path: Path) -> None:
    """A training that is looked at learns what one learns that nobody looks at, which never meets for viewers."""
    first, second = ranks.run(work.watched, 2, str(tmp_path / "watched"), "looks_on")
    assert len(first["pictures"]) > 1
    assert first["met"]
    assert second["met"]
    alone = ranks.run(work.watched, 2, str(tmp_path / "plain"), "is_not_there")
    assert not any(rank["met"] for rank in alone)
    expected = work.work.last_tensors(RunDirectory(tmp_path / "plain"))
    found = work.work.last_tensors(RunDirectory(tmp_path / "watched"))
    assert found.keys() == expected.keys()
    different = [name for name, value in expected.items() if not found[name].equal(value)]
    assert all("seconds" in name for name in different), different


@pytest.mark.parametrize(("what", "code"), [("stops", 130), ("is signalled", 143)])
def test_all_ranks_stop_in_a_pause(ranks: Ranks, tmp_path: Path, what: str, code: int) -> None:
    """By the viewer's button, and by a signal to another rank than the one with the viewer: after the step they had."""
    for rank in ranks.run(work.watched, 2, str(tmp_path / "run"), what):
        assert rank["end"] == (code, "step_000001.pt")
        assert rank["step"] == 1


def test_a_training_whose_last_tab_is_closed_goes_on(ranks: Ranks, tmp_path: Path) -> None:
    """Also while it pauses; the copy is let go."""
    first, second = ranks.run(work.watched, 2, str(tmp_path / "run"), "leaves")
    assert first["step"] == second["step"] == work.STEPS
    assert list(first["pictures"]) == [1]
    assert not first["has copy"]


@pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed")
def test_a_page_that_cannot_be_served_ends_all(ranks: Ranks, tmp_path: Path) -> None:
    """Rank 0 says why; the others end without a word, also where they were not asked for a page."""
    first, second = ranks.run(work.served_where_nobody_can, 2, str(tmp_path / "run"))
    assert "203.0.113.7" in first
    assert second == "ends with 2"
