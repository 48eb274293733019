"""Density control by sampling: dead Gaussians move, the number grows to a budget, noise moves faint ones."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config import DensificationConfig
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gradient_control import Refinement
from thermosplat.training.density.mcmc import McmcStrategy
from toy_run import (
    assert_same_state,
    density_in_steps,
    many_frames,
    state_tensors,
    stopped_and_resumed,
    toy_run_config,
    toy_trainer,
)
from toy_scene import toy_capture

FINE = torch.zeros(())
SPECTRA: list[dict[str, dict[str, Any]]] = [{}, {"nir": {"opacity": "own"}}]
"""Beside RGB and thermal."""


def strategy_of(gaussians: Gaussians, **config: Any) -> McmcStrategy:
    settings = density_in_steps(**({"strategy": "mcmc", "max_gaussians": 1000} | config))
    return McmcStrategy(settings, 3.0, len(gaussians), "cpu")


def mcmc_config(max_steps: int = 12, *, spectra: dict[str, dict[str, Any]] | None = None, **changes: Any) -> Any:
    config = toy_run_config(max_steps, spectra=spectra)
    densification = dataclasses.replace(config.densification, strategy="mcmc", max_gaussians=70, **changes)
    loss = dataclasses.replace(config.loss, opacity_reg=0.01, scale_reg=0.01)
    return dataclasses.replace(config, densification=densification, loss=loss)


def test_dead_ones_move_and_the_number_grows() -> None:
    """Dead in both spectra means dead; they go to living ones; then 5% are added."""
    gaussians = random_gaussians(100)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.logit_opacities.fill_(0.0)
        gaussians.logit_opacities[:10] = -9.0
        gaussians.thermal_opacity_offsets[:3] = 9.0  # thermal still sees them
    optimizers = stepped_optimizers(gaussians)
    strategy = strategy_of(gaussians)
    clear = gaussians.means[:3].detach().clone()
    refinement = strategy.refine(gaussians, optimizers, 601, torch.Generator().manual_seed(0))
    assert refinement == Refinement(cloned=5, relocated=7)
    assert len(gaussians) == 105
    assert torch.equal(gaussians.means[:3], clear)
    larger = torch.maximum(gaussians.opacities, gaussians.opacities_in("thermal"))
    assert (larger > 0.005).all()


def test_dead_means_dead_in_every_spectrum() -> None:
    """Of three opacities one is enough to live; what moves is faint in all, and shares each of its new place."""
    gaussians = random_gaussians(100, others={"nir": "own", "blue": "shared"})
    optimizers = stepped_optimizers(gaussians)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.logit_opacities.fill_(0.0)
        gaussians.logit_nir_opacities.fill_(1.0)
        gaussians.logit_opacities[:10] = -9.0
        gaussians.logit_nir_opacities[:10] = -9.0
        gaussians.thermal_opacity_offsets[:3] = 9.0  # thermal alone sees these
        gaussians.logit_nir_opacities[3:5] = 0.0  # and near infrared these
    means = gaussians.means.detach().clone()
    strategy = strategy_of(gaussians, growth=0.0)
    assert strategy.refine(gaussians, optimizers, 601, torch.Generator().manual_seed(0)) == Refinement(relocated=5)
    assert torch.equal(gaussians.means[:5], means[:5])
    assert all((means[10:] == mean).all(dim=1).any() for mean in gaussians.means[5:10])
    for name in ("rgb", "nir", "thermal", "blue"):
        assert (gaussians.opacities_in(name)[5:10] > 0.1).all()


def test_budget_is_kept() -> None:
    """Growth ends at the budget exactly, and never starts above it."""
    for count, expected in ((99, 100), (100, 100), (120, 120)):
        gaussians = random_gaussians(count)
        strategy = strategy_of(gaussians, max_gaussians=100)
        strategy.refine(gaussians, stepped_optimizers(gaussians), 601, torch.Generator().manual_seed(0))
        assert len(gaussians) == expected


@pytest.mark.parametrize("apart", [0.0, 0.6])
@pytest.mark.parametrize("sample_by", ["opacity", "gradient"])
def test_full_sets_keep_their_tensors(sample_by: str, apart: float) -> None:
    """At the budget, or when growth has stopped, a refinement works in place, and says so beforehand."""
    for count, growing in ((100, True), (50, False)):
        gaussians = random_gaussians(count)
        with torch.no_grad():
            gaussians.logit_opacities.fill_(0.0)
            gaussians.logit_opacities[:7] = -20.0
            gaussians.thermal_opacity_offsets.zero_()
        optimizers = stepped_optimizers(gaussians)
        strategy = strategy_of(gaussians, max_gaussians=100, sample_by=sample_by, split_apart=apart)
        strategy.growing = growing
        strategy.grad_norm_sum.fill_(0.5)
        strategy.observations.fill_(2.0)

        def places(gaussians: Gaussians = gaussians, optimizers: Any = optimizers, sums: Any = strategy) -> list[int]:
            moments = [m for o in optimizers.values() for state in o.state.values() for m in state.values()]
            tensors = (*gaussians.parameters(), *moments, sums.grad_norm_sum, sums.observations)
            return [tensor.data_ptr() for tensor in tensors]

        before = places()
        assert not strategy.replaces_tensors(gaussians)
        refinement = strategy.refine(gaussians, optimizers, 601, torch.Generator().manual_seed(0))
        assert refinement is not None
        assert refinement.cloned == 0
        assert 0 < refinement.relocated <= 7
        assert places() == before
        assert not strategy.grad_norm_sum.any()
        assert not strategy.observations.any()
    assert strategy_of(gaussians, max_gaussians=100).replaces_tensors(gaussians)


def test_all_dead_is_an_error() -> None:
    """Nobody to move to: the run stops with the step."""
    gaussians = random_gaussians(3)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(-9.0)
        gaussians.thermal_opacity_offsets.zero_()
    with pytest.raises(UserError, match="No Gaussian is left to relocate to at step 601"):
        strategy_of(gaussians).refine(gaussians, stepped_optimizers(gaussians), 601, torch.Generator())


def test_gradients_can_choose_who_is_doubled() -> None:
    """With sample_by gradient, all new ones come from the one Gaussian that has a gradient."""
    gaussians = random_gaussians(40)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(1.0)
    strategy = strategy_of(gaussians, sample_by="gradient")
    means2d = torch.zeros(1, 40, 2, requires_grad=True)
    means2d.grad = torch.zeros(1, 40, 2)
    means2d.grad[0, 17] = 1.0
    visible = torch.ones(1, 40, dtype=torch.bool)
    strategy.observe([{"means2d": means2d, "visible": visible, "width": 8, "height": 8, "n_cameras": 1}], FINE)
    strategy.refine(gaussians, stepped_optimizers(gaussians), 601, torch.Generator().manual_seed(0))
    assert torch.equal(gaussians.means[40:], gaussians.means[17].expand(2, 3))
    assert strategy.grad_norm_sum.tolist() == [0.0] * 42


def test_half_are_chosen_by_gradients() -> None:
    """With sample_by both, half of the new ones come from the one that has a gradient, whatever its opacity."""
    gaussians = random_gaussians(400)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.logit_opacities.fill_(1.0)
        gaussians.logit_opacities[0] = -4.0
    strategy = strategy_of(gaussians, sample_by="both", growth=1.0, max_gaussians=800)
    strategy.grad_norm_sum[0], strategy.observations[0] = 3.0, 2.0
    strategy.refine(gaussians, stepped_optimizers(gaussians), 601, torch.Generator().manual_seed(0))
    assert len(gaussians) == 800
    of_the_first = (gaussians.means[400:] == gaussians.means[0]).all(dim=1).sum()
    assert 160 <= of_the_first <= 240  # of 400: half, within four deviations


def test_nobody_moves_onto_the_dead() -> None:
    """However large the gradient of a dead Gaussian is, the living ones are moved to."""
    gaussians = random_gaussians(40)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.logit_opacities.fill_(1.0)
        gaussians.logit_opacities[:20] = -9.0
    strategy = strategy_of(gaussians, sample_by="gradient", growth=0.0)
    strategy.grad_norm_sum[:20], strategy.grad_norm_sum[20:] = 1.0, 1e-3
    assert strategy.refine(
        gaussians, stepped_optimizers(gaussians), 601, torch.Generator().manual_seed(0)
    ) == Refinement(relocated=20)
    assert (gaussians.opacities > 0.005).all()


def test_what_is_doubled_may_split() -> None:
    """With split_apart dead ones become halves of living ones, and new ones too; no source splits twice at a time."""
    gaussians = random_gaussians(100)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.logit_opacities.fill_(0.0)
        gaussians.logit_opacities[:60] = -9.0
    strategy = strategy_of(gaussians, split_apart=0.6)
    refinement = strategy.refine(gaussians, stepped_optimizers(gaussians), 601, torch.Generator().manual_seed(0))
    assert refinement is not None
    assert 0 < refinement.relocated <= 40
    assert 0 < refinement.cloned <= 5
    assert len(gaussians) == 100 + refinement.cloned
    assert (gaussians.opacities > 0.005).sum() == 40 + refinement.relocated + refinement.cloned
    assert len(gaussians.means[gaussians.opacities > 0.005].unique(dim=0)) == (gaussians.opacities > 0.005).sum()


def test_noise_has_the_covariance_it_should() -> None:
    """Faint Gaussians move with standard deviations λ σ(k t) Σ along their axes; clear and blocked ones do not."""
    gaussians = random_gaussians(20_000)
    with torch.no_grad():
        gaussians.means.zero_()
        gaussians.quats.copy_(torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5]).expand(20_000, 4))  # x axis to y axis
        gaussians.log_scales.copy_(torch.tensor([0.2, 0.1, 0.05]).log().expand(20_000, 3))
        gaussians.logit_opacities.fill_(-20.0)
        gaussians.thermal_opacity_offsets.zero_()
        gaussians.thermal_opacity_offsets[10_000:] = 25.0  # clear in thermal
    optimizers = stepped_optimizers(gaussians)
    with torch.no_grad():
        gaussians.means.zero_()
    strategy = strategy_of(gaussians, position_noise=100.0)
    strategy.move(gaussians, optimizers, torch.ones(()), torch.Generator().manual_seed(0))
    assert not gaussians.means.any()
    strategy.move(gaussians, optimizers, FINE, torch.Generator().manual_seed(0))
    rate = optimizers["means"].param_groups[0]["lr"]
    gate = torch.sigmoid(torch.tensor(0.5)).item()
    expected = 100.0 * rate / 3.0**2 * gate * torch.tensor([0.1, 0.2, 0.05]) ** 2
    torch.testing.assert_close(gaussians.means[:10_000].std(dim=0), expected, rtol=0.1, atol=0)
    assert gaussians.means[10_000:].abs().max() < 1e-30


@pytest.mark.parametrize("clear", ["thermal", "nir", "red_edge", None])
def test_noise_leaves_alone_what_one_spectrum_sees(clear: str | None) -> None:
    """Of several opacities the largest counts, however it is stored."""
    gaussians = random_gaussians(50, others={"nir": "own", "red_edge": "offset"})
    optimizers = stepped_optimizers(gaussians)
    with torch.no_grad():
        gaussians.log_scales.fill_(-1.0)
        gaussians.logit_opacities.fill_(-20.0)
        gaussians.logit_nir_opacities.fill_(5.0 if clear == "nir" else -20.0)
        gaussians.thermal_opacity_offsets.fill_(25.0 if clear == "thermal" else 0.0)
        gaussians.red_edge_opacity_offsets.fill_(25.0 if clear == "red_edge" else 0.0)
    before = gaussians.means.detach().clone()
    strategy_of(gaussians).move(gaussians, optimizers, FINE, torch.Generator().manual_seed(0))
    moved = (gaussians.means.detach() - before).abs().amax(dim=-1)
    assert (moved < 1e-30).all() if clear else (moved > 1e-4).all()


def test_noise_is_the_same_in_all_units() -> None:
    """A scene ten times as large, with means' rates ten times as large, is shaken by ten times as much."""
    moves = []
    for unit in (1.0, 10.0):
        gaussians = random_gaussians(50)
        optimizers = stepped_optimizers(gaussians)
        with torch.no_grad():
            gaussians.log_scales += math.log(unit)
            gaussians.logit_opacities.fill_(-20.0)
            gaussians.thermal_opacity_offsets.zero_()
        optimizers["means"].param_groups[0]["lr"] *= unit
        strategy = McmcStrategy(DensificationConfig(strategy="mcmc", max_gaussians=50), 3.0 * unit, 50, "cpu")
        before = gaussians.means.detach().clone()
        strategy.move(gaussians, optimizers, FINE, torch.Generator().manual_seed(0))
        moves.append(gaussians.means.detach() - before)
    assert moves[0].abs().max() > 1e-6
    torch.testing.assert_close(moves[1], 10.0 * moves[0], rtol=1e-3, atol=1e-5)


@pytest.mark.rotating
@pytest.mark.parametrize("spectra", SPECTRA)
@pytest.mark.parametrize("apart", [0.0, 0.6])
def test_a_run_grows_to_its_budget(tmp_path: Path, spectra: dict[str, dict[str, Any]], apart: float) -> None:
    """Refinements add Gaussians up to the budget, never reset, and the penalties are among the losses."""
    config = mcmc_config(24, spectra=spectra, split_apart=apart)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(others=tuple(spectra))))
    while trainer.step < 24:
        trainer.train_step()
    assert trainer.model.num_gaussians == 70
    assert trainer.guard.first_bad() is None
    assert not any(strategy.resets_at(step) for strategy in trainer.state.strategies.values() for step in range(1, 25))


def test_out_of_memory_behind_the_update(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters have moved: the checkpoint counts that step as done, and it is not done again."""
    config, capture = mcmc_config(10), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    while trainer.step < 5:
        trainer.train_step()

    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(McmcStrategy, "move", full)
    with pytest.raises(UserError, match="memory"):
        trainer.train()
    checkpoint = load_checkpoint(trainer.run.checkpoint(6))
    assert checkpoint.step == 6
    assert checkpoint.training.optimizers is not None
    of_means = checkpoint.training.optimizers["shared"]["means"]["state"][0]
    assert of_means["step"] == 6


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("spectra", SPECTRA)
def test_resumed_run_draws_the_same_noise(tmp_path: Path, spectra: dict[str, dict[str, Any]]) -> None:
    """Noise is a function of seed and step: a run that stopped ends as one that did not."""
    config, capture = mcmc_config(10, spectra=spectra), many_frames(toy_capture(others=tuple(spectra)))
    whole = toy_trainer(tmp_path / "whole", config, capture)
    while whole.step < 10:
        whole.train_step()
    resumed = stopped_and_resumed(tmp_path / "half", config, capture, 5)
    while resumed.step < 10:
        resumed.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(whole))
