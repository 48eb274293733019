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

    def initialize_state(self, *, scene_scale: float) -> dict[str, Any]:
        return {}

    def step_pre_backward(self, *_: Any) -> None: ...

    def step_post_backward(self, *_: Any, packed: bool) -> None: ...


class Relocating:
    """Stands for its MCMCStrategy: the same calls, with a limit and a rate."""

    made: "list[Relocating]" = []  # noqa: RUF012  (a record of the test)

    def __init__(self, *, cap_max: int) -> None:
        self.cap_max, self.rates, self.opacities = cap_max, [], []
        self.made.append(self)

    def check_sanity(self, params: Any, _: Any) -> None:
        self.first = {name: value.detach().clone() for name, value in params.items()}

    def initialize_state(self) -> dict[str, Any]:
        return {}

    def step_pre_backward(self, *_: Any) -> None: ...

    def step_post_backward(self, *_: Any, lr: float) -> None:
        self.rates.append(lr)


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, with what stands for gsplat."""
    gsplat, strategy = ModuleType("gsplat"), ModuleType("gsplat.strategy")
    monkeypatch.setattr(gsplat, "rasterization", rasterization, raising=False)
    monkeypatch.setattr(strategy, "DefaultStrategy", Strategy, raising=False)
    monkeypatch.setattr(strategy, "MCMCStrategy", Relocating, raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setitem(sys.modules, "gsplat.strategy", strategy)
    monkeypatch.setitem(sys.modules, "train_gsplat_peer", None)  # so that it goes when the test ends
    del sys.modules["train_gsplat_peer"]
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(Relocating, "made", [])
    import train_gsplat_peer

    return train_gsplat_peer


@pytest.mark.parametrize("spectrum", ["rgb", "thermal"])
def test_each_spectrum_is_trained_alone(peer: ModuleType, spectrum: str) -> None:
    """On the frames that have it; its quality and cost are told."""
    capture = many_frames(toy_capture())
    first, *rest = capture.train
    other = "thermal" if spectrum == "rgb" else "rgb"
    object.__setattr__(capture, "train", (without(first, spectrum), *(without(frame, other) for frame in rest)))
    found = peer.train(capture, spectrum, 4, capture.scene_extent, 1, torch.device("cpu"))
    assert (found["spectrum"], found["steps"], found["num_gaussians"]) == (spectrum, 4, 60)
    assert found["strategy"] == "default"
    assert found["psnr"] > 4


def test_a_limit_of_gaussians_is_mcmcs(peer: ModuleType) -> None:
    """It starts from small Gaussians of opacity 0.5, and its noise is that of the normalised capture."""
    capture = many_frames(toy_capture())
    found = peer.train(capture, "rgb", 4, 2.0, 1, torch.device("cpu"), 100)
    (strategy,) = Relocating.made
    assert (found["strategy"], strategy.cap_max) == ("mcmc", 100)
    assert strategy.first["opacities"].sigmoid().allclose(torch.tensor(0.5))
    plain = peer.initial_parameters(capture.points, capture.point_colors, torch.device("cpu"))
    assert strategy.first["scales"].exp().allclose(0.1 * plain["scales"].exp())

    views = [frame.views["rgb"] for frame in (*capture.train, *capture.test)]
    unit = peer.normalized_unit(torch.stack([torch.as_tensor(view.viewmat) for view in views]))
    expected = [1.6e-4 * 2.0 * 0.01 ** ((step + 1) / 4) / unit**2 for step in range(4)]
    assert strategy.rates == pytest.approx(expected)


def test_the_unit_is_the_distance_from_what_cameras_look_at(peer: ModuleType) -> None:
    """Cameras on a circle about a point; the unit grows with the world and does not depend on where it is."""
    angles = torch.arange(8) * torch.pi / 4
    zero, one = torch.zeros(8), torch.ones(8)
    turns = torch.stack([angles.cos(), zero, angles.sin(), zero, one, zero, -angles.sin(), zero, angles.cos()], 1)
    viewmats = torch.eye(4).repeat(8, 1, 1)
    viewmats[:, :3, :3] = turns.reshape(8, 3, 3)
    viewmats[:, 2, 3] = 3.0  # the origin is 3 in front of each
    assert peer.normalized_unit(viewmats) == pytest.approx(3.0)
    viewmats[:, :3, 3] *= 5
    assert peer.normalized_unit(viewmats) == pytest.approx(15.0)


@pytest.mark.parametrize(("words", "limit"), [([], None), (["--strategy", "mcmc"], 1_000_000)])
def test_a_capture_of_photographs_alone_is_trained_without_flags(
    peer: ModuleType, monkeypatch: pytest.MonkeyPatch, words: list[str], limit: int | None
) -> None:
    """Spectra that a capture does not have are left out; mcmc has gsplat's own limit."""
    capture, seen = many_frames(toy_capture()), []
    object.__setattr__(capture, "train", tuple(without(frame, "thermal") for frame in capture.train))
    monkeypatch.setattr(peer, "load_capture", lambda _: capture)
    monkeypatch.setattr(peer, "train", lambda *given: seen.append((given[1], given[-1])) or {})
    monkeypatch.setattr(sys, "argv", ["train_gsplat_peer.py", "DATA", *words])
    peer.main()
    assert seen == [("rgb", limit)]


def test_a_limit_needs_mcmc(peer: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat's DefaultStrategy would ignore it."""
    monkeypatch.setattr(sys, "argv", ["train_gsplat_peer.py", "DATA", "--cap-max", "1000"])
    with pytest.raises(SystemExit):
        peer.main()
