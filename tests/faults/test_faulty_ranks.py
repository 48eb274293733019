"""One rank of a training fails in the middle of a step: all end with one message, the checkpoint and how to go on."""

import shutil
import socket
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest

from faulty_ranks import trained
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory

pytestmark = pytest.mark.slow

STEPS = 6


def ended(tmp_path: Path, fault: str) -> tuple[list[int], str]:
    """Exit codes, and what the ranks wrote, of a training of the sample."""
    return trained(tmp_path / "log", fault, "sample", (tmp_path, tmp_path), tmp_path / "run")


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("out of memory", "On rank 1 of 2, with a share of the Gaussians."),
        ("rank 0 out of memory", "On rank 0 of 2, with a share of the Gaussians."),
        ("less memory", "On rank 1 of 2, with a share of the Gaussians."),
        ("a bug", "This rank failed, and the training ended with it."),
    ],
)
def test_a_failing_rank_ends_all(tmp_path: Path, fault: str, said: str) -> None:
    """The other one waits in an exchange at that moment, and says nothing."""
    codes, text = ended(tmp_path, fault)
    assert codes == ([1, 1] if fault == "a bug" else [2, 2])
    assert text.count("─ Error ─") == 1
    assert said in text
    assert text.count("Traceback") == (1 if fault == "a bug" else 0)
    (saved,) = RunDirectory(tmp_path / "run").checkpoints()
    assert load_checkpoint(saved).step == 2
    assert saved.name in text
    assert f"thermosplat-train --resume {tmp_path / 'run'}" in text


def test_a_rank_that_is_late_is_waited_for(tmp_path: Path) -> None:
    """And the training is the one of ranks that are not."""
    codes, text = ended(tmp_path, "late")
    assert codes == [0, 0]
    assert "─ Error ─" not in text
    late = RunDirectory(tmp_path / "run").latest_checkpoint()
    (tmp_path / "other").mkdir()
    ended(tmp_path / "other", "none")
    in_time = RunDirectory(tmp_path / "other" / "run").latest_checkpoint()
    assert late is not None
    assert in_time is not None
    one, other = (load_checkpoint(path).state()["model"]["gaussian_sets"]["shared"] for path in (late, in_time))
    assert one.keys() == other.keys()
    for name in one:
        assert (one[name] == other[name]).all(), name


def test_a_full_disk_at_the_end_names_the_last_checkpoint(tmp_path: Path) -> None:
    """That of step 2 was written before; nothing half-written is left."""
    codes, text = ended(tmp_path, "full disk")
    assert codes == [2, 2]
    assert text.count("─ Error ─") == 1
    run = RunDirectory(tmp_path / "run")
    assert [path.name for path in run.checkpoints()] == ["step_000002.pt"]
    assert "step_000002.pt" in text


def test_hosts_with_different_images_are_told_which(tmp_path: Path) -> None:
    """The file's name and the host's, once; before anything is written."""
    import cv2

    with as_file(files("thermosplat") / "sample") as sample:
        for host in ("one", "other"):
            shutil.copytree(sample, tmp_path / host / "capture")
    changed = sorted((tmp_path / "other" / "capture").rglob("*.jpg"))[3]
    image = cv2.imread(str(changed))
    assert image is not None
    cv2.imwrite(str(changed), np.clip(image.astype(int) + 30, 0, 255).astype(np.uint8))
    folders = tmp_path / "one", tmp_path / "other"
    codes, text = trained(tmp_path / "log", "none", "capture", folders, tmp_path / "run")
    assert codes == [2, 2]
    assert text.count("─ Error ─") == 1
    assert changed.name in text
    assert socket.gethostname() in text
    assert not (tmp_path / "run").exists()
