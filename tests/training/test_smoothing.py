"""The 3D smoothing filter in a training."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from graphs_on_cpu import RecordedOnCPU
from thermosplat.config import DensificationConfig
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.scene.smoothing_filter import filter_deviations, sampling_cameras
from thermosplat.training.joined_scenes import joined
from thermosplat.training.trainer import Trainer
from toy_run import many_frames, toy_run_config, toy_sizes, toy_trainer
from toy_scene import render, toy_capture, toy_config, toy_frame, toy_model

MCMC = DensificationConfig(strategy="mcmc", max_gaussians=90, start_step=4, stop_step=60, every=5, split_apart=0.6)
KINDS: dict[str, dict[str, Any]] = {
    "default": {},
    "mcmc": {"densification": MCMC},
    "two scenes": {"densification": MCMC, "scenes": 2, "budget": "auto"},
}


def smoothed_trainer(path: Path, kind: str, steps: int) -> Trainer:
    """A toy run with the filter."""
    config = toy_run_config(max_steps=steps, model={"filter_3d": True}, **KINDS[kind])
    if config.scenes > 1:
        config = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, cooldown_from=0.6))
    return toy_trainer(path, config, many_frames(toy_capture()))


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_ends_with_the_filter_in_its_gaussians(tmp_path: Path, kind: str) -> None:
    """Every step has a filter for each Gaussian; what is saved renders as it was judged, without one."""
    with toy_sizes():
        trainer = smoothed_trainer(tmp_path, kind, 24)
        numbers = []

        def look(now: Trainer) -> None:
            gaussians = now.model.gaussians("shared")
            assert gaussians.filter_3d is not None
            assert gaussians.filter_3d.shape == (len(gaussians),)
            assert (gaussians.filter_3d > 0).all()
            numbers.append(len(gaussians))

        trainer.between_steps = look
        metrics = trainer.train()
    assert len(set(numbers)) > 1
    assert trainer.model.gaussians("shared").filter_3d is None
    loaded = load_run(str(tmp_path), device="cpu")
    assert loaded.model.gaussians("shared").filter_3d is None
    narrowest = filter_deviations(
        loaded.model.gaussians("shared").means.detach(),
        sampling_cameras(trainer.capture, loaded.model.sets_of_spectra)["shared"],
    )
    assert (loaded.model.gaussians("shared").scales.detach() >= 0.9 * narrowest.amin()).all()
    assert metrics["num_gaussians"] == loaded.model.num_gaussians


@pytest.mark.parametrize("kind", ["default", "mcmc"])
def test_recorded_steps_read_the_filter_where_it_is(tmp_path: Path, kind: str) -> None:
    """Replays never find that another filter took the place of theirs."""
    with toy_sizes():
        trainer = smoothed_trainer(tmp_path, kind, 60)
        trainer.steps.recordings = on_cpu = RecordedOnCPU(trainer.device_step, len(trainer.frames))
        while trainer.step < 60:
            trainer.train_step()
    assert on_cpu.replays > 10


def test_joined_scenes_are_as_opaque_as_one_through_the_filter() -> None:
    """Two of a set in one place show about what it shows, though the filter makes small Gaussians fainter."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    frame, cameras = toy_frame(capture), sampling_cameras(capture, model.sets_of_spectra)["shared"]
    gaussians = model.gaussians("shared")
    gaussians.filter_3d = 30.0 * filter_deviations(gaussians.means.detach(), cameras)
    with torch.no_grad():
        gaussians.logit_opacities += 6.0
        one = render(model, frame).alphas
        model.gaussian_sets["shared"] = both = joined([gaussians, gaussians])
        two = render(model, frame).alphas
    assert both.filter_3d is not None
    for name, alpha in one.items():
        drawn = alpha > 0.1
        assert drawn.sum() > 100
        assert (two[name] - alpha)[drawn].abs().mean() < 0.05
