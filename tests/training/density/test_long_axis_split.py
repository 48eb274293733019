"""Gaussians become two along their longest axis."""

import math

import pytest
import torch
from torch import Tensor

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config.schema import SPLIT_APART_MOST
from thermosplat.scene.gaussians import Gaussians
from thermosplat.spectra import Opacity
from thermosplat.training.density.long_axis_split import halves_opacities, split, split_onto


def covariances(gaussians: Gaussians) -> Tensor:
    """R S S R^T of every Gaussian, by its quaternion's matrix, [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats.detach().double(), dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotations = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    axes = rotations * gaussians.scales.detach().double()[:, None, :]
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("apart", [0.1, 0.6, SPLIT_APART_MOST])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 1.0])
def test_line_integral_stays(opacity: float, apart: float) -> None:
    """Blended along the line through both, the two cover as much as the one, and neither is clearer than can be."""
    half = halves_opacities(torch.tensor(opacity, dtype=torch.float64), apart).item()
    assert 0 < half < 1
    x = torch.linspace(-20.0, 20.0, 200_001, dtype=torch.float64)
    sigma = math.sqrt(1 - apart**2)
    left, right = (half * torch.exp(-0.5 * ((x + side * apart) / sigma) ** 2) for side in (1, -1))
    together = torch.trapezoid(1 - (1 - left) * (1 - right), x).item()
    assert together == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)


def test_two_have_the_mean_and_covariance_of_the_one() -> None:
    """Along the longest axis, whichever it is and however it is turned; everything else is copied."""
    gaussians = random_gaussians(12)
    optimizers = stepped_optimizers(gaussians)
    means, before = gaussians.means.detach().clone(), covariances(gaussians)
    sources = torch.tensor([1, 4, 7])
    split(gaussians, optimizers, sources, 0.7, least=0.005)
    assert len(gaussians) == 15
    halves = gaussians.means[sources], gaussians.means[12:]
    torch.testing.assert_close((halves[0] + halves[1]) / 2, means[sources])
    half = (halves[0] - means[sources]).detach().double()
    found = covariances(gaussians)
    torch.testing.assert_close(found[sources], found[12:])
    torch.testing.assert_close(
        found[sources] + half[:, :, None] * half[:, None, :], before[sources], rtol=1e-4, atol=1e-7
    )
    longest = torch.linalg.eigvalsh(before[sources])[:, -1].sqrt()
    torch.testing.assert_close(half.norm(dim=-1), 0.7 * longest, rtol=1e-4, atol=0)
    for name, parameter in gaussians.named_parameters():
        if name != "means":
            assert torch.equal(parameter[sources], parameter[12:]), name
        assert not optimizers[name].state[parameter]["exp_avg"][[1, 4, 7, 12, 13, 14]].any(), name
        assert optimizers[name].state[parameter]["exp_avg"][0].any(), name
    others = [k for k in range(12) if k not in (1, 4, 7)]
    assert torch.equal(gaussians.means[others], means[others])


def test_every_opacity_is_halved() -> None:
    """Own logits and offsets of further spectra too, each by itself; none falls below the least that was above it."""
    others: dict[str, Opacity] = {"nir": "own", "red_edge": "offset"}
    gaussians = random_gaussians(2, others=others)
    optimizers = stepped_optimizers(gaussians)
    opacities = {"rgb": [0.1, 0.3], "thermal": [0.2, 0.0051], "nir": [0.9, 0.2], "red_edge": [0.3, 0.001]}
    logits = {name: torch.logit(torch.tensor(values)) for name, values in opacities.items()}
    gaussians.set_opacity_logits(torch.arange(2), logits["rgb"], logits)
    split(gaussians, optimizers, torch.tensor([0, 1]), 0.6, least=0.005)
    for name, values in opacities.items():
        expected = halves_opacities(torch.tensor(values, dtype=torch.float64), 0.6)
        least = torch.tensor(values, dtype=torch.float64).clamp(max=0.005)
        expected = torch.maximum(expected, least).float()
        torch.testing.assert_close(gaussians.opacities_in(name), expected.repeat(2), rtol=1e-4, atol=0)


def test_moved_ones_are_second_halves() -> None:
    """Their number stays; what they were is gone."""
    plain, onto = random_gaussians(6), random_gaussians(6)
    sources, moved = torch.tensor([3, 5]), torch.tensor([0, 2])
    split(plain, stepped_optimizers(plain), sources, 0.5, least=0.005)
    optimizers = stepped_optimizers(onto)
    split_onto(onto, optimizers, moved, sources, 0.5, least=0.005)
    assert len(onto) == 6
    for (name, found), (_, expected) in zip(onto.named_parameters(), plain.named_parameters(), strict=True):
        assert torch.equal(found[sources], expected[sources]), name
        assert torch.equal(found[moved], expected[6:]), name
        assert torch.equal(found[[1, 4]], expected[[1, 4]]), name
        assert not optimizers[name].state[found]["exp_avg"][[0, 2, 3, 5]].any(), name
