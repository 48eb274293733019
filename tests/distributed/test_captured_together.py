"""Ranks record steps and replay them together, with room for what they exchange, and do what lines do one by one."""

from pathlib import Path

import pytest
import torch

import divided_runs as work
from ranks import Ranks

STEPS = 30


@pytest.mark.rotating
@pytest.mark.parametrize("kind", ["still", "default", "mcmc", pytest.param("withheld", marks=pytest.mark.slow)])
def test_replayed_steps_are_those_of_lines(ranks: Ranks, tmp_path: Path, kind: str) -> None:
    """Where Gaussians come and go, or are divided anew, too: recordings are forgotten then, by all ranks."""
    lines = ranks.run(work.steps_taken, 2, str(tmp_path / "lines"), kind, STEPS, False)
    replays = ranks.run(work.steps_taken, 2, str(tmp_path / "replays"), kind, STEPS, True)
    for line_by_line, replayed in zip(lines, replays, strict=True):
        assert replayed["captures"] >= 1
        assert replayed["replays"] >= 10
        assert replayed["replays"] == replays[0]["replays"]
        assert replayed["tensors"].keys() == line_by_line["tensors"].keys()
        for name, value in line_by_line["tensors"].items():
            torch.testing.assert_close(replayed["tensors"][name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_a_rank_with_other_frames_keeps_all_from_replaying(ranks: Ranks, tmp_path: Path) -> None:
    """A frame without one of the views is work of its own; nobody waits for a rank that does something else."""
    for share in ranks.run(work.steps_taken, 2, str(tmp_path), "uneven", STEPS, True):
        assert share["step"] == STEPS
