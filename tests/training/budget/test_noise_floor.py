"""Views are not fitted below the noise of their images."""

import dataclasses
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.losses.image_terms import compare_frame
from thermosplat.training.budget.noise_floor import gradient_shares, noise_floors
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.image_noise import training_noise
from thermosplat.training.sensor_facts import SensorFacts
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from toy_run import (
    assert_same_state,
    many_frames,
    state_tensors,
    step_gradients,
    tolerating,
    toy_run_config,
    toy_trainer,
)
from toy_scene import toy_capture


def noisy(capture: Capture, **sigmas: float) -> Capture:
    """The capture with grey training images of some spectra and noise of so many 8-bit steps."""

    def spoilt(frame: Frame, number: int) -> Frame:
        views = dict(frame.views)
        for name, sigma in sigmas.items():
            random = np.random.default_rng(number)
            image = random.normal(128, sigma, views[name].image.shape).clip(0, 255).astype(np.uint8)
            views[name] = dataclasses.replace(views[name], image=image)
        return dataclasses.replace(frame, views=views)

    return dataclasses.replace(capture, train=tuple(map(spoilt, capture.train, range(len(capture.train)))))


def floored(**changes: Any) -> TrainConfig:
    """A short run whose budget does nothing else."""
    return toy_run_config(budget="auto", auto_budget=AutoBudgetConfig(prune_at=()), **changes)


@pytest.fixture(autouse=True)
def _no_budget_but_the_floor() -> Iterator[None]:
    with tolerating(offset_shrinkage=0.0, sh_change=0.0, rounding_change=0.0):
        yield


def trained(trainer: Trainer, steps: int) -> Trainer:
    """The trainer, so many steps from its start."""
    while trainer.step < steps:
        trainer.train_step()
    return trainer


def watch_of(trainer: Trainer, floor: float) -> NoiseWatch:
    """With one floor for all RGB images."""
    return NoiseWatch({"rgb": floor}, len(trainer.frames), trainer.device)


def gradients(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Gradients of a step on the first frame, by parameter."""
    trainer.state.clear_gradients()
    step_gradients(trainer, StepKind(0, densifying=False))
    model = trainer.model.named_parameters()
    return {name: parameter.grad.clone() for name, parameter in model if parameter.grad is not None}


def test_floor_is_a_share_of_the_noise_of_each_spectrum(tmp_path: Path) -> None:
    """The variance of what was added, times the share; the run says so. A fixed budget has none."""
    capture = noisy(many_frames(toy_capture(), 12), rgb=12, thermal=3)
    with tolerating(noise_floor=0.8):
        trainer = toy_trainer(tmp_path / "a", floored(), capture)
    floors, notes = noise_floors(
        trainer.config, SensorFacts(trainer.config, partial(training_noise, trainer.frames)), 0.8
    )
    assert floors["rgb"] == pytest.approx(0.8 * (12 / 255) ** 2, rel=0.15)
    assert floors["thermal"] == pytest.approx(0.8 * (3 / 255) ** 2, rel=0.2)
    assert trainer.state.noise_watch is not None
    assert trainer.state.noise_watch.noise == floors
    for name, of_frames in trainer.state.noise_watch.floors.items():
        assert of_frames.tolist() == pytest.approx([floors[name]] * len(trainer.frames))
    assert trainer.recipe.notes == notes
    limit = -10 * math.log10(floors["rgb"])
    assert notes[0].startswith("Noise of the RGB images at least 0.04")
    assert notes[0].endswith(f"training views are fitted up to {limit:.1f} dB.")
    plain = toy_trainer(tmp_path / "b", toy_run_config(), capture)
    assert (plain.state.noise_watch, plain.recipe.notes) == (None, ())


def test_images_without_noise_have_no_floor(tmp_path: Path) -> None:
    """Of an even image any error is the model's."""
    trainer = toy_trainer(tmp_path, floored(), noisy(many_frames(toy_capture()), rgb=0, thermal=0))
    assert trainer.state.noise_watch is None


def test_a_view_below_the_floor_has_no_gradient_in_that_spectrum_alone(tmp_path: Path) -> None:
    """The other spectrum's gradients are what they are where the first one has no loss at all."""
    capture = many_frames(toy_capture())
    trainer = toy_trainer(tmp_path / "a", toy_run_config(), capture)
    free = gradients(trainer)
    trainer.state.noise_watch = watch_of(trainer, 1e-9)
    above = gradients(trainer)
    trainer.state.noise_watch = watch_of(trainer, 10.0)
    below = gradients(trainer)
    alone = gradients(
        toy_trainer(tmp_path / "b", toy_run_config(spectra={"rgb": {"loss": 0.0, "features": 0.0}}), capture)
    )
    assert free.keys() == above.keys()
    assert all(torch.equal(above[name], free[name]) for name in free)
    sh0 = next(name for name in free if name.endswith("sh0"))
    assert free[sh0].abs().max() > 0
    assert below[sh0].abs().max() == 0
    for name, gradient in alone.items():
        assert torch.equal(below[name], gradient), name
    assert any(gradient.abs().max() > 0 for gradient in alone.values())


@pytest.mark.parametrize("fused", [False, True])
def test_shares_are_of_all_terms_of_a_spectrum(tmp_path: Path, fused: bool) -> None:
    """Images, features and smoothness alike, by torch and by the kernels; a spectrum without a floor is not listed."""
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    frame, offsets = trainer.frames[0], trainer.model.gaussians("shared").get_parameter("thermal_opacity_offsets")
    for factor, is_above in ((0.99, True), (1.01, False)):
        rendered = trainer.model.render(frame.views, sh_degree=0, shared_cameras=frame.shared_cameras)
        compared = compare_frame(rendered, frame, trainer.config, fused=fused)
        shares = gradient_shares(compared, {"thermal": factor * compared.squared_errors["thermal"]})
        assert set(shares) == {"thermal", "features_thermal", "thermal_smoothness"}
        assert all(share.item() == is_above for share in shares.values())
        offsets.grad = None
        one = torch.ones(())
        torch.autograd.backward(list(compared.losses.values()), [shares.get(name, one) for name in compared.losses])
        assert offsets.grad is not None
        assert bool(offsets.grad.abs().max() > 0) == is_above


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("batch_size", [None, 2])
@tolerating(noise_floor=3.0)
def test_resumed_run_is_the_same(tmp_path: Path, batch_size: int | None) -> None:
    """Floors come from the images, so a run that is cut in two ends with the same bits; some views are below."""
    capture = noisy(many_frames(toy_capture()), rgb=60, thermal=60)
    config = floored(batch_size=batch_size)
    whole = trained(toy_trainer(tmp_path / "whole", config, capture), 6)
    half = trained(toy_trainer(tmp_path / "half", config, capture), 3)
    half.save()
    resumed = trained(Trainer.resume(config, capture, half.run), 6)
    assert_same_state(state_tensors(resumed), state_tensors(whole))
    with tolerating(noise_floor=0.0):
        free = trained(toy_trainer(tmp_path / "free", config, capture), 6)
    assert not torch.equal(free.model.gaussians("shared").sh0, whole.model.gaussians("shared").sh0)
