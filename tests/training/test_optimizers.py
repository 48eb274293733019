"""Learning rates follow the published schedule, and a blocked step changes nothing."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config import OptimizerConfig
from thermosplat.scene.gaussians import offsets_name, own_logits_name, sh_names
from thermosplat.training.optimizers import (
    gaussian_optimizers,
    learning_rate,
    load_optimizer,
    set_learning_rates,
    step_unless,
)

CONFIG = OptimizerConfig()


@pytest.mark.parametrize(
    ("name", "progress", "expected"),
    [
        ("means", 0.0, 1.6e-4 * 3.0),
        ("means", 0.5, 1.6e-5 * 3.0),
        ("means", 1.0, 1.6e-6 * 3.0),
        ("means", 1.5, 1.6e-6 * 3.0),
        ("poses", 0.0, 1e-4 * 3.0),
        ("cameras", 1.0, 5e-6 * 3.0),
        ("decoders", 0.0, 5e-3),
        ("decoders", 1.0, 5e-4),
        ("log_scales", 0.7, 5e-3),
        ("logit_opacities", 0.7, 5e-2),
        ("quats", 0.7, 1e-3),
        ("sh0", 0.7, 2.5e-3),
        ("shN", 0.7, 2.5e-3 / 20),
        ("features", 0.0, 5e-3),
        ("features", 1.0, 5e-4),
        ("thermal_opacity_offsets", 0.7, 5e-2),
        ("logit_nir_opacities", 0.7, 5e-2),
        ("red_edge_sh0", 0.7, 2.5e-3),
        ("red_edge_shN", 0.7, 2.5e-3 / 20),
    ],
)
def test_published_rates(name: str, progress: float, expected: float) -> None:
    """Lengths, features and decoders decay exponentially; means are in units of the scene, cameras of the images."""
    assert learning_rate(name, CONFIG, progress, scale=3.0) == pytest.approx(expected)


def test_rates_may_decay() -> None:
    """A final value of their own or a share of all others, half way by the square root; a rate of 0 stays 0."""
    config = OptimizerConfig(features_lr=4e-3, features_lr_final=1e-3, final_share=0.25, quats_lr=0.0)
    assert learning_rate("features", config, 0.5, 1.0) == pytest.approx(2e-3)
    assert learning_rate("features", config, 1.0, 1.0) == pytest.approx(1e-3)
    assert learning_rate("sh0", config, 0.5, 1.0) == pytest.approx(config.sh0_lr / 2)
    assert learning_rate("decoders", config, 1.0, 1.0) == pytest.approx(config.decoders_lr_final)
    assert learning_rate("quats", config, 0.5, 1.0) == 0.0


@pytest.mark.parametrize(
    ("progress", "share"), [(0.0, 1.0), (0.8, 1.0), (0.9, 0.5), (0.95, 0.25), (1.0, 0.0), (1.5, 0.0)]
)
def test_rates_may_fall_to_zero(progress: float, share: float) -> None:
    """In a straight line over the last fifth, whatever their own decay is; before it they are as they were."""
    config = OptimizerConfig(cooldown_from=0.8)
    for name in ("means", "features", "decoders", "quats", "thermal_opacity_offsets"):
        without = learning_rate(name, CONFIG, progress, 1.0)
        assert learning_rate(name, config, progress, 1.0) == pytest.approx(share * without), name


def test_opacities_of_spectra_have_rates_of_their_kind() -> None:
    """Whatever a spectrum is called, its offsets, own logits and colours take the rate that is set for those."""
    config = OptimizerConfig(opacities_lr=0.1, sh0_lr=0.4, shN_lr=0.5)
    for spectrum in ("thermal", "nir", "logit", "band_1"):
        names = (offsets_name(spectrum), own_logits_name(spectrum), *sh_names(spectrum), "logit_opacities")
        rates = [learning_rate(name, config, 0.5, 1.0) for name in names]
        assert rates == [0.1, 0.1, 0.4, 0.5, 0.1], spectrum


def test_every_parameter_has_its_rate() -> None:
    """Rates are set parameter by parameter, and there is one optimizer for each."""
    gaussians = random_gaussians(3, others={"nir": "own", "red_edge": "offset"})
    optimizers = gaussian_optimizers(gaussians, CONFIG)
    set_learning_rates(optimizers, CONFIG, progress=1.0, scale=2.0)
    assert set(optimizers) == {name for name, _ in gaussians.named_parameters()}
    for name, optimizer in optimizers.items():
        assert optimizer.param_groups[0]["lr"] == learning_rate(name, CONFIG, 1.0, 2.0)
        assert optimizer.param_groups[0]["eps"] == 1e-15


def test_higher_harmonics_may_decay() -> None:
    """Without gradients those of every spectrum lose rate times decay of themselves, unless blocked; no other does."""
    gaussians = random_gaussians(3, others={"nir": "own"})
    config = OptimizerConfig(shN_lr=0.1, shN_decay=2.0)
    optimizers = gaussian_optimizers(gaussians, config)
    set_learning_rates(optimizers, config, 0.0, 1.0)
    before = {name: parameter.detach().clone() for name, parameter in gaussians.named_parameters()}
    for blocked, kept in ((1.0, 1.0), (0.0, 0.8)):
        for parameter in gaussians.parameters():
            parameter.grad = torch.zeros_like(parameter)
        step_unless(torch.full((), blocked), {"set": optimizers})
        for name, parameter in gaussians.named_parameters():
            share = kept if name.endswith("shN") else 1.0
            torch.testing.assert_close(parameter.detach(), share * before[name], msg=name)


def test_blocked_step_leaves_everything() -> None:
    """NaN gradients behind the flag touch neither parameters, moments nor step count; without it they would."""
    gaussians = random_gaussians(3)
    optimizers = stepped_optimizers(gaussians)
    before = {name: parameter.detach().clone() for name, parameter in gaussians.named_parameters()}
    for parameter in gaussians.parameters():
        parameter.grad = torch.full_like(parameter, torch.nan)
    step_unless(torch.ones(()), {"set": optimizers})
    for name, parameter in gaussians.named_parameters():
        assert torch.equal(parameter, before[name])
        state = optimizers[name].state[parameter]
        assert torch.isfinite(state["exp_avg"]).all()
        assert state["step"] == 1
    step_unless(torch.zeros(()), {"set": optimizers})
    assert torch.isnan(gaussians.means).all()


def test_degree_zero_has_an_empty_parameter() -> None:
    """Adam steps over shN [N, 0, 3] of a model without higher spherical harmonics."""
    gaussians = random_gaussians(3, thermal=False)
    gaussians.shN = torch.nn.Parameter(torch.zeros(3, 0, 3))
    before = gaussians.means.detach().clone()
    optimizers = gaussian_optimizers(gaussians, CONFIG)
    set_learning_rates(optimizers, CONFIG, 0.0, 1.0)
    for parameter in gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    step_unless(torch.zeros(()), {"set": optimizers})
    assert (gaussians.means < before).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda moments: moments.pop("exp_avg_sq"), "holds exp_avg, step"),
        (lambda moments: moments.update(exp_avg=moments["exp_avg"][:2]), r"exp_avg of an optimizer has the shape \[2"),
        (lambda moments: moments.update(step=torch.zeros(2)), r"step of an optimizer has the shape \[2\]"),
        (lambda moments: moments.update(max=torch.zeros(2)), "holds exp_avg, exp_avg_sq, max, step"),
    ],
)
def test_moments_that_do_not_fit_are_refused(change: Callable[[dict[str, torch.Tensor]], Any], message: str) -> None:
    """What Adam would fail with, or read beyond its end, is found when a checkpoint is loaded."""
    gaussians = random_gaussians(3)
    saved = copy.deepcopy(stepped_optimizers(gaussians)["means"].state_dict())
    change(saved["state"][0])
    with pytest.raises(ValueError, match=message):
        load_optimizer(gaussian_optimizers(gaussians, CONFIG)["means"], saved)


def test_rates_and_settings_are_the_optimizers_own() -> None:
    """A checkpoint brings moments; what its file says of settings is not taken over."""
    gaussians = random_gaussians(3)
    saved = copy.deepcopy(stepped_optimizers(gaussians)["means"].state_dict())
    saved["param_groups"][0] |= {"betas": ("a", None), "eps": -1.0, "lr": 7.0, "rate": 3.0}
    optimizer = gaussian_optimizers(gaussians, CONFIG)["means"]
    before = {key: value for key, value in optimizer.param_groups[0].items() if key != "params"}
    load_optimizer(optimizer, saved)
    assert {key: value for key, value in optimizer.param_groups[0].items() if key != "params"} == before
    assert torch.equal(optimizer.state[gaussians.means]["exp_avg"], saved["state"][0]["exp_avg"])
