"""gsplat's own training runs on any spectrum of a capture, here with our rasterizer under gsplat's name."""

import sys
from types import ModuleType
from typing import Any

import pytest
import torch

from thermosplat import rasterization
from toy_run import many_frames, without
from toy_scene import toy_capture


class Strategy:
    """Stands for gsplat's DefaultStrategy, which does nothing in so few steps."""

    def check_sanity(self, *_: Any) -> None: ...

    def initialize_state(self, **_: Any) -> dict[str, Any]:
        return {}

    def step_pre_backward(self, *_: Any) -> None: ...

    def step_post_backward(self, *_: Any, **__: Any) -> None: ...


@pytest.mark.parametrize("spectrum", ["rgb", "thermal"])
def test_each_spectrum_is_trained_alone(monkeypatch: pytest.MonkeyPatch, spectrum: str) -> None:
    """On the frames that have it; its quality and cost are told."""
    gsplat, strategy = ModuleType("gsplat"), ModuleType("gsplat.strategy")
    monkeypatch.setattr(gsplat, "rasterization", rasterization, raising=False)
    monkeypatch.setattr(strategy, "DefaultStrategy", Strategy, raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setitem(sys.modules, "gsplat.strategy", strategy)
    monkeypatch.setitem(sys.modules, "train_gsplat_peer", None)  # so that it goes when the test ends
    del sys.modules["train_gsplat_peer"]
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    from train_gsplat_peer import train

    capture = many_frames(toy_capture())
    first, *rest = capture.train
    other = "thermal" if spectrum == "rgb" else "rgb"
    object.__setattr__(capture, "train", (without(first, spectrum), *(without(frame, other) for frame in rest)))
    found = train(capture, spectrum, 4, capture.scene_extent, 1, torch.device("cpu"))
    assert (found["spectrum"], found["steps"], found["num_gaussians"]) == (spectrum, 4, 60)
    assert found["psnr"] > 4
