"""Replays on the CPU, where what was recorded is run again, and on CUDA, where it is replayed."""

import pytest
import torch

from rasterizer_replays import SEEN, Bench
from thermosplat.rasterizer.replay import replayed_calls


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls are captured when they were seen twice."""
    monkeypatch.setattr(replayed_calls, "SEEN", SEEN)


@pytest.fixture(params=[True, False], ids=["copied", "straight"])
def backgrounds(request: pytest.FixtureRequest) -> bool:
    """Whether there are backgrounds: without them images are blended straight into the caller's memory."""
    return bool(request.param)


@pytest.fixture
def bench(device: torch.device, backgrounds: bool) -> Bench:
    """Of ``rasterization``."""
    return Bench(device, backgrounds=backgrounds)


@pytest.fixture(params=[False, True], ids=["rgb", "rgbt"])
def either_bench(device: torch.device, backgrounds: bool, request: pytest.FixtureRequest) -> Bench:
    """Of each function."""
    return Bench(device, request.param, backgrounds=backgrounds)
