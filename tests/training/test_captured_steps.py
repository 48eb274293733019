"""A captured step does what the lines do one by one."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rolling_captures import shaken
from thermosplat.config import AutoBudgetConfig, DensificationConfig, ResolutionConfig
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.rasterizer import pair_capacity
from thermosplat.training.recorded_steps import RecordedSteps
from thermosplat.training.session.run_metrics import feature_channels
from thermosplat.training.trainer import Trainer
from toy_run import enlarged, many_frames, state_tensors, tolerating, toy_run_config, toy_trainer
from toy_scene import toy_capture

pytestmark = pytest.mark.cuda
SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "shared": ({}, {}),
    "shared, two cameras": ({}, {"aligned": False}),
    "shared, cameras that are refined": (
        {
            "refine": ("poses", "rig", "intrinsics", "distortion"),
            "refine_from": 2,
            "refine_every": 8,
            "refine_first": 10,
        },
        {"aligned": False},
    ),
    "separate, scalar thermal": ({"model": SEPARATE}, {"thermal_kind": "scalar"}),
    "shared, spherical harmonics of either spectrum": (
        {"model": {"feature_dim": 0}, "spectra": {"thermal": {"opacity": "own"}}},
        {},
    ),
    "three spectra, three opacities": ({"spectra": {"nir": {"opacity": "offset"}}}, {"others": ("nir",)}),
    "three spectra, spherical harmonics": (
        {"model": {"feature_dim": 0}, "spectra": {"nir": {"opacity": "own"}}},
        {"others": ("nir",), "aligned": False},
    ),
    "shared, pixels that do not count": ({}, {"masked": True}),
    "shared, thermal lines that are read one after the other": ({}, {"aligned": False, "shaken": ("thermal",)}),
}


def masked(capture: Capture) -> Capture:
    """The capture with other masks in each frame, but for the first, which has none."""

    def of_frame(frame: Frame, number: int) -> Frame:
        views = {}
        for name, view in frame.views.items():
            mask = np.ones(view.image.shape[:2], np.bool_)
            mask[number : number + 8, : 4 * number] = False
            views[name] = dataclasses.replace(view, mask=mask if number else None)
        return Frame(frame.name, views)

    return dataclasses.replace(capture, train=tuple(map(of_frame, capture.train, range(len(capture.train)))))


def recordings(trainer: Trainer) -> RecordedSteps:
    """What a trainer has recorded."""
    assert trainer.steps.recordings is not None
    return trainer.steps.recordings


def _run(path: Path, kind: str, steps: int, *, of: int | None = None, **changes: Any) -> Trainer:
    """A toy run after so many steps, ``of`` as many."""
    settings, capture = KINDS[kind]
    config = dataclasses.replace(toy_run_config(max_steps=of or steps, **settings), device="cuda", **changes)
    how = dict(capture)
    rolling, are_masked = how.pop("shaken", ()), how.pop("masked", False)
    taken = shaken(many_frames(toy_capture(**how)), rolling)
    trainer = toy_trainer(path, config, masked(taken) if are_masked else taken)
    while trainer.step < steps:
        trainer.train_step()
    return trainer


@pytest.mark.parametrize("kind", KINDS)
def test_captured_steps_match_plain_ones(tmp_path: Path, kind: str) -> None:
    """After forty steps without densification the states agree to rounding, and graphs did most of them."""
    still = DensificationConfig(stop_step=0)
    plain = _run(tmp_path / "plain", kind, 40, graph=False, densification=still, deterministic=True)
    captured = _run(tmp_path / "captured", kind, 40, graph=True, densification=still, deterministic=True)
    assert plain.steps.recordings is None
    assert recordings(captured).graphs
    ours, theirs = state_tensors(captured), state_tensors(plain)
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        if value.is_floating_point() and value.numel() and ".model." in name:
            # Adam turns the rounding of small gradients into whole steps: a few parameters differ, the mass does not
            close = torch.isclose(ours[name], value, rtol=1e-2, atol=1e-2)
            assert close.float().mean() > 0.97, name


@pytest.mark.parametrize("kind", KINDS)
def test_densification_goes_on_between_captured_steps(tmp_path: Path, kind: str) -> None:
    """Gaussians are added, removed and reset, graphs follow, and the loss falls."""
    trainer = _run(tmp_path, kind, 42)
    assert recordings(trainer).graphs
    assert trainer.guard.first_bad() is None
    counts = {name: len(gaussians) for name, gaussians in trainer.state.gaussian_sets.items()}
    assert all(strategy.grad_norm_sum.shape == (counts[name],) for name, strategy in trainer.state.strategies.items())
    metrics = trainer.results.evaluate().metrics
    assert metrics["spectra"] == list(trainer.model.spectra)
    assert all(metrics[name]["psnr"] > 5 for name in metrics["spectra"])


def test_noise_and_exposures_are_captured(tmp_path: Path) -> None:
    """MCMC's noise is drawn anew in every replay, the same as without graphs; every frame's exposure learns.

    Swept depths draw the scene; in the second half the spread of depths counts, too, which is another graph.
    """
    mcmc = DensificationConfig(strategy="mcmc", max_gaussians=300, start_step=4, stop_step=60, every=10)

    def run(name: str, graph: bool) -> Trainer:
        thermal = {"exposure": "affine", "squared": 30.0, "swept_depth": 0.1, "point_spread": 0.02}
        robust = {"rgb": {"exposure": "affine"}, "thermal": thermal}
        config = toy_run_config(max_steps=40, spectra=robust)
        loss = dataclasses.replace(config.loss, opacity_reg=0.01, scale_reg=0.01, depth_spread=0.1)
        config = dataclasses.replace(config, device="cuda", graph=graph, densification=mcmc, loss=loss)
        trainer = toy_trainer(tmp_path / name, config, many_frames(toy_capture()))
        while trainer.step < 40:
            trainer.train_step()
        return trainer

    plain, captured = run("plain", False), run("captured", True)
    assert {(work.kind.swept_depths, work.kind.depth_spread) for work in recordings(captured).graphs} == {(True, True)}
    assert captured.guard.first_bad() is None
    assert captured.model.num_gaussians == plain.model.num_gaussians > 60
    ours, theirs = captured.state.exposures, plain.state.exposures
    assert ours is not None
    assert theirs is not None
    assert ours.maps["rgb"].abs().amax(dim=(1, 2)).min() > 0
    torch.testing.assert_close(ours.maps["rgb"], theirs.maps["rgb"], rtol=0.2, atol=2e-3)


def test_images_that_grow_are_captured_anew(tmp_path: Path) -> None:
    """Each size is measured, captured and replayed; the states agree with steps that are not recorded."""

    def run(name: str, graph: bool) -> tuple[Trainer, list[tuple[int, int]]]:
        sizes = ResolutionConfig(factors=(1.5, 1.2), until=(0.3, 0.6))
        config = toy_run_config(max_steps=60, resolution=sizes, densification=DensificationConfig(stop_step=0))
        config = dataclasses.replace(config, device="cuda", graph=graph)
        trainer, seen = toy_trainer(tmp_path / name, config, enlarged(many_frames(toy_capture()), 3)), []
        while trainer.step < 60:
            trainer.train_step()
            if trainer.steps.recordings is not None and recordings(trainer).graphs:
                seen += [
                    (len(recordings(trainer).graphs), held.views["rgb"].width)
                    for (held,) in recordings(trainer).frames.values()
                ]
        return trainer, seen

    (plain, _), (captured, seen) = run("plain", False), run("captured", True)
    assert {number for number, _ in seen} == {1}
    assert list(dict.fromkeys(width for _, width in seen)) == [48, 60, 72]
    assert len(seen) > 30
    assert captured.guard.first_bad() is None
    ours, theirs = state_tensors(captured), state_tensors(plain)
    for name, value in theirs.items():
        if value.is_floating_point() and value.numel() and ".model." in name:
            close = torch.isclose(ours[name], value, rtol=1e-2, atol=1e-2)
            assert close.float().mean() > 0.97, name


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_another_device_than_the_first(tmp_path: Path) -> None:
    """Steps on cuda:1 are captured there."""
    try:
        config = dataclasses.replace(toy_run_config(max_steps=20), device="cuda:1")
        trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
        before = trainer.model.gaussians("shared").means.detach().clone()
        while trainer.step < 20:
            trainer.train_step()
        assert recordings(trainer).graphs
        assert trainer.guard.first_bad() is None
        means = trainer.model.gaussians("shared").means
        assert means.device == torch.device("cuda:1")
        assert not torch.equal(means[: len(before)], before)
    finally:
        torch.cuda.set_device(0)


def test_graphs_outlive_relocation(tmp_path: Path) -> None:
    """Once no Gaussians are added, refinements move them in place, and the same graph goes on with them."""
    full = DensificationConfig(strategy="mcmc", max_gaussians=60, start_step=4, stop_step=60, every=10)
    trainer = _run(tmp_path, "shared", 24, of=40, densification=full)
    gaussians = trainer.model.gaussians("shared")
    assert len(gaussians) == 60
    before = dict(recordings(trainer).graphs)
    assert before
    with torch.no_grad():
        gaussians.logit_opacities[:5] = -9.0
        gaussians.thermal_opacity_offsets[:5] = 0.0
    means = gaussians.means[:5].detach().clone()
    while trainer.step < 34:  # one refinement
        trainer.train_step()
    assert recordings(trainer).graphs == before
    assert (gaussians.opacities[:5] > 0.005).all()
    assert ((gaussians.means[:5] - means).norm(dim=-1) > 0.01).all()
    assert trainer.guard.first_bad() is None


@tolerating(prune_change=0.0, feature_change=1e9, measured_views=2)
def test_fewer_latent_channels_are_captured_anew(tmp_path: Path) -> None:
    """Steps with other kernels than before are captured once these are loaded, and go on as without graphs."""
    budget = AutoBudgetConfig(prune_at=(0.5,))
    still = DensificationConfig(stop_step=0)

    changes = {"densification": still, "budget": "auto", "auto_budget": budget}
    plain = _run(tmp_path / "plain", "shared", 40, graph=False, **changes)
    captured = _run(tmp_path / "captured", "shared", 40, graph=True, **changes)
    assert recordings(captured).graphs
    assert captured.guard.first_bad() is None
    assert feature_channels(captured.model) == feature_channels(plain.model) == 1
    ours, theirs = captured.model.gaussians("shared"), plain.model.gaussians("shared")
    torch.testing.assert_close(ours.means, theirs.means, rtol=0.05, atol=5e-3)


def test_a_step_that_does_not_fit_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With too little room the parameters stay; after a look there is room, and training goes on."""
    still = DensificationConfig(stop_step=0)
    trainer = _run(tmp_path, "shared", 20, densification=still, log_every=1000)
    captured = trainer.steps
    (kind,) = {work.kind for work in recordings(trainer).graphs}
    captured.forget()
    trainer.state.step = 0  # past its last step the schedule names no spectrum
    capacity = captured.step.capacity
    most = capacity.most.clone()
    capacity.most.fill_(1)  # as if frames had hardly any pairs
    monkeypatch.setattr(pair_capacity, "LEAST", 10)
    before = trainer.model.gaussians("shared").means.detach().clone()
    with captured.run(kind):
        pass
    assert capacity.overflow == 1
    assert torch.equal(trainer.model.gaussians("shared").means, before)
    capacity.most.copy_(most)
    captured.check_overflow()
    assert not recordings(trainer).graphs
    with captured.run(kind):
        pass
    assert capacity.overflow == 0
    assert not torch.equal(trainer.model.gaussians("shared").means, before)


def test_resume_from_captured_steps(tmp_path: Path) -> None:
    """A checkpoint of a captured run goes on, on CUDA and on the CPU."""
    trainer = _run(tmp_path / "first", "shared", 20)
    trainer.save()
    for device in ("cuda", "cpu"):
        config = dataclasses.replace(trainer.config, device=device, max_steps=24)
        resumed = Trainer.resume(config, trainer.capture, trainer.run)
        assert resumed.step == 20
        while resumed.step < 24:
            resumed.train_step()
        assert resumed.guard.first_bad() is None


@pytest.mark.parametrize("graph", [False, True])
def test_deterministic_runs_are_the_same_to_the_bit(tmp_path: Path, graph: bool) -> None:
    """Two runs with the same seed end with the same bits, refinements and compiled decoders included."""
    first = _run(tmp_path / "first", "shared", 42, graph=graph, compile=True, deterministic=True)
    second = _run(tmp_path / "second", "shared", 42, graph=graph, compile=True, deterministic=True)
    ours, theirs = state_tensors(first), state_tensors(second)
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        assert torch.equal(ours[name], value), name
