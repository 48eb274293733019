"""Replays on the CPU, where what was recorded is run again, and on CUDA, where it is replayed."""

import pytest
import torch

from rasterizer_replays import SEEN, Bench
from thermosplat.rasterizer.replay import replayed_calls


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls are captured when they were seen twice."""
    monkeypatch.setattr(replayed_calls, "SEEN", SEEN)


@pytest.fixture
def bench(device: torch.device) -> Bench:
    """Of ``rasterization``."""
    return Bench(device)


@pytest.fixture(params=[False, True], ids=["rgb", "rgbt"])
def either_bench(device: torch.device, request: pytest.FixtureRequest) -> Bench:
    """Of each function."""
    return Bench(device, request.param)
