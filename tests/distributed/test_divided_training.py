"""One scene trained by several ranks is the scene that one process trains with the same batches."""

import json
from pathlib import Path

import pytest
import torch

import divided_runs as work
from ranks import Ranks
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer

STEPS = 10
SLOW = [(kind, 3) for kind in ("uneven", "absgrad", "separate", "decomposing", "exposures", "lens", "budget", "sizes")]
CASES = [
    ("default", 2),
    ("mcmc", 2),
    ("refine", 3),
    ("scenes", 2),
    *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW),
]


def assert_close(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """Equal but for the order in which gradients are summed."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].shape == value.shape, name
        scale = float(value.abs().max()) if value.numel() and value.is_floating_point() else 0.0
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-4 * max(scale, 1e-6), msg=name)


def judged(folder: Path) -> dict[str, float]:
    """PSNR [dB] of every evaluation of a run, by file and spectrum."""
    found = {}
    for path in RunDirectory(folder).stats.glob("step_*.json"):
        numbers = json.loads(path.read_text())
        found |= {f"{path.name} {name}": numbers[name]["psnr"] for name in ("rgb", "thermal")}
    assert found
    return found


@pytest.mark.rotating
@pytest.mark.parametrize(("kind", "count"), CASES)
def test_ten_steps_equal_one_process(ranks: Ranks, tmp_path: Path, kind: str, count: int) -> None:
    """Density control, resets, cameras and missing views included; the checkpoints are of the same shape."""
    expected = work.trained_alone(str(tmp_path / "alone"), kind, STEPS)
    shares = ranks.run(work.trained, count, str(tmp_path / "divided"), kind, STEPS)
    assert_close(work.last_tensors(RunDirectory(tmp_path / "divided")), expected)
    assert judged(tmp_path / "divided") == pytest.approx(judged(tmp_path / "alone"), abs=0.01)
    total = sum(sum(share["own"]) for share in shares)
    assert total == sum(shares[0]["metrics"]["gaussians"].values())
    assert max(share["own"][0] for share in shares) - min(share["own"][0] for share in shares) <= 1


def test_a_run_goes_on_on_any_number_of_ranks(ranks: Ranks, tmp_path: Path) -> None:
    """Two ranks, then three, then one process, each from the checkpoint of those before."""
    expected = work.trained_alone(str(tmp_path / "alone"), "default", 4, 7, STEPS)
    folder = str(tmp_path / "divided")
    ranks.run(work.trained, 2, folder, "default", 4)
    ranks.run(work.trained, 3, folder, "default", 7, True)
    run = RunDirectory(folder)
    Trainer.resume(work.config("default", STEPS), work.capture("default"), run).train()
    assert_close(work.last_tensors(run), expected)


def test_another_capture_of_a_rank_is_refused_by_name(ranks: Ranks) -> None:
    """The rank that has it says which view; the others end without a word of their own."""
    *others, last = ranks.run(work.refused_capture, 3)
    assert others == ["ends with 2", "ends with 2"]
    assert "the thermal view of the training frame" in last
    assert "rank 2" in last
