"""What goes wrong on one rank ends all of them, or none; nothing hangs, and nothing that is saved is lost."""

from pathlib import Path

import divided_runs as work
from ranks import Ranks
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory


def test_a_full_disk_and_a_late_rank_stop_nobody(ranks: Ranks, tmp_path: Path) -> None:
    """A checkpoint in between is done without; the last one is written."""
    said = ranks.run(work.trained_with_a_full_disk, 2, str(tmp_path / "run"), False)
    assert said == ["trained to step 4"] * 2
    assert [path.name for path in RunDirectory(tmp_path / "run").checkpoints()] == ["step_000004.pt"]


def test_a_disk_that_stays_full_ends_all(ranks: Ranks, tmp_path: Path) -> None:
    """Rank 0 says so; the others end without a word."""
    first, second = ranks.run(work.trained_with_a_full_disk, 2, str(tmp_path / "run"), True)
    assert "no space" in first
    assert "No checkpoint of this training is saved" in first
    assert second == "ends with 2"


def test_a_loss_that_is_not_finite_stops_all_before_its_update(ranks: Ranks, tmp_path: Path) -> None:
    """Of a rank that is not the first; what is saved is finite, and of the step before."""
    first, second = ranks.run(work.stopped_by_a_bad_loss, 2, str(tmp_path / "run"))
    assert "NaN or infinite at step 3" in first
    assert second == "ends with 2"
    run = RunDirectory(tmp_path / "run")
    path = run.latest_checkpoint()
    assert path is not None
    assert load_checkpoint(path).step == 2
    assert all(value.isfinite().all() for value in work.last_tensors(run).values() if value.is_floating_point())


def test_a_signal_to_one_rank_stops_all_after_the_step(ranks: Ranks, tmp_path: Path) -> None:
    """With the same step, the same code, and one checkpoint of it."""
    said = ranks.run(work.stopped_by_a_signal, 3, str(tmp_path / "run"))
    (code, step, path), *others = said
    assert (code, step) == (143, 3)
    assert all(other == (code, step, path) for other in others)
    assert load_checkpoint(Path(path)).step == step
