"""Gaussians become several without their image changing."""

import pytest
import torch

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config import OptimizerConfig
from thermosplat.fused.relocation import scale_factors
from thermosplat.spectra import Opacity
from thermosplat.training.density.relocation import add, relocate
from thermosplat.training.optimizers import gaussian_optimizers


def test_relocated_ones_are_copies_that_share() -> None:
    """Two go to one and one to another: equal parameters afterwards, either opacity shared, no moments, same number."""
    gaussians = random_gaussians(6)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(0.4)
        gaussians.thermal_opacity_offsets.copy_(torch.linspace(-1.0, 1.0, 6))
    optimizers = stepped_optimizers(gaussians)
    visible, thermal = gaussians.opacities.detach(), gaussians.opacities_in("thermal").detach()
    untouched = gaussians.means[4].detach().clone()
    relocate(gaussians, optimizers, torch.tensor([0, 1, 2]), torch.tensor([3, 5, 3]), least=0.005)
    assert len(gaussians) == 6
    for group, n in (([0, 2, 3], 3), ([1, 5], 2)):
        source = group[-1]
        for name, parameter in gaussians.named_parameters():
            assert torch.equal(parameter[group], parameter[source].expand_as(parameter[group])), name
            assert not optimizers[name].state[parameter]["exp_avg"][group].any(), name
        for before, now in ((visible, gaussians.opacities), (thermal, gaussians.opacities_in("thermal"))):
            assert 1 - (1 - now[source].item()) ** n == pytest.approx(before[source].item(), rel=1e-4)
    assert torch.equal(gaussians.means[4], untouched)
    assert optimizers["means"].state[gaussians.means]["exp_avg"][4].any()


def test_every_opacity_is_shared() -> None:
    """Own logits and offsets of further spectra too, each by itself; sizes follow the clearest of all."""
    others: dict[str, Opacity] = {"nir": "own", "red_edge": "offset"}
    gaussians = random_gaussians(3, others=others)
    opacities = {"rgb": [0.1, 0.3, 0.5], "thermal": [0.2] * 3, "nir": [0.9, 0.2, 0.4], "red_edge": [0.3, 0.6, 0.1]}
    logits = {name: torch.logit(torch.tensor(values)) for name, values in opacities.items()}
    gaussians.set_opacity_logits(torch.arange(3), logits["rgb"], logits)
    optimizers = gaussian_optimizers(gaussians, OptimizerConfig())
    before = gaussians.scales.detach().clone()
    add(gaussians, optimizers, torch.tensor([0, 1, 1]), least=0.005)
    for name, values in opacities.items():
        now = gaussians.opacities_in(name)
        for source, n in ((0, 2), (1, 3)):
            assert 1 - (1 - now[source].item()) ** n == pytest.approx(values[source], rel=1e-4), name
        assert torch.equal(now[[3, 4, 5]], now[[0, 1, 1]])
        assert now[2].item() == pytest.approx(values[2])
    clearest = torch.tensor([0.9, 0.6], dtype=torch.float64)
    factors = scale_factors(clearest, torch.tensor([2, 3])).float()
    torch.testing.assert_close(gaussians.scales[:2], before[:2] * factors[:, None])


def test_opaque_ones_are_shared_without_infinities() -> None:
    """An opacity that rounds to 1 has no logit; what is left of it after sharing has."""
    gaussians = random_gaussians(4)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(200.0)
    relocate(gaussians, stepped_optimizers(gaussians), torch.tensor([0]), torch.tensor([1]), least=0.005)
    for name, parameter in gaussians.named_parameters():
        assert torch.isfinite(parameter[[0, 1]]).all(), name
    assert 0.5 < gaussians.opacities[0].item() <= 1.0


def test_added_ones_come_last_and_share() -> None:
    """A doubled Gaussian gets smaller and fainter with its copy; nobody falls below the least opacity by sharing."""
    gaussians = random_gaussians(4)
    with torch.no_grad():
        gaussians.logit_opacities.copy_(torch.logit(torch.tensor([0.8, 0.5, 0.006, 0.5])))
        gaussians.thermal_opacity_offsets.zero_()
    optimizers = stepped_optimizers(gaussians)
    scales = gaussians.scales.detach()
    add(gaussians, optimizers, torch.tensor([0, 2, 2]), least=0.005)
    assert len(gaussians) == 7
    assert torch.equal(gaussians.means[[4, 5, 6]], gaussians.means[[0, 2, 2]])
    assert (gaussians.scales[0] < scales[0]).all()
    torch.testing.assert_close(gaussians.opacities[[2, 5, 6]], torch.full((3,), 0.005), rtol=0.05, atol=0)
    assert optimizers["means"].state[gaussians.means]["exp_avg"].shape == (7, 3)


def test_equal_opacities_stay_equal() -> None:
    """An offset of zero, one opacity in both spectra, is still zero after sharing."""
    gaussians = random_gaussians(3)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
    optimizers = stepped_optimizers(gaussians)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.zero_()
    add(gaussians, optimizers, torch.tensor([0, 1, 1]), least=0.005)
    assert not gaussians.thermal_opacity_offsets.any()


def test_sizes_follow_the_clearer_spectrum() -> None:
    """A Gaussian that is clear in thermal and faint in RGB gets as small as its thermal opacity asks for."""
    gaussians = random_gaussians(2)
    with torch.no_grad():
        gaussians.logit_opacities.copy_(torch.logit(torch.tensor([0.1, 0.9])))
        gaussians.thermal_opacity_offsets.copy_(torch.logit(torch.tensor([0.9, 0.1])) - gaussians.logit_opacities)
    before = gaussians.scales.detach().clone()
    add(gaussians, gaussian_optimizers(gaussians, OptimizerConfig()), torch.tensor([0, 1]), least=0.005)
    factors = scale_factors(torch.full((2,), 0.9, dtype=torch.float64), torch.tensor([2, 2])).float()
    torch.testing.assert_close(gaussians.scales[:2], before * factors[:, None])


def test_doubled_ones_start_without_moments() -> None:
    """Adam forgets those that were doubled, as it does their copies, and no others."""
    gaussians = random_gaussians(4)
    optimizers = stepped_optimizers(gaussians)
    add(gaussians, optimizers, torch.tensor([2]), least=0.005)
    for name, parameter in gaussians.named_parameters():
        for moment in ("exp_avg", "exp_avg_sq"):
            held = optimizers[name].state[parameter][moment].reshape(5, -1)
            assert held.any(dim=1).tolist() == [True, True, False, True, False], name
