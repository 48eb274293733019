"""Offsets step towards zero, and stop there."""

import pytest
import torch
from random_gaussians import random_gaussians, stepped_optimizers

from thermosplat.training.offset_shrinkage import drop_offsets, hold_zeros, shrink_offsets

FINE = torch.zeros(())


def test_soft_threshold() -> None:
    """Every offset moves towards zero by λ times its learning rate, not across it."""
    gaussians = random_gaussians(3)
    optimizers = stepped_optimizers(gaussians)
    offsets = gaussians.thermal_opacity_offsets
    with torch.no_grad():
        offsets.copy_(torch.tensor([0.5, -0.02, 0.02]))
    offsets.grad = torch.zeros(3)
    shrink_offsets(gaussians, optimizers, 2.0, torch.ones(()))
    assert offsets.tolist() == pytest.approx([0.5, -0.02, 0.02])
    shrink_offsets(gaussians, optimizers, 2.0, FINE)  # of the opacities' rate 0.05
    assert offsets.tolist() == pytest.approx([0.4, 0.0, 0.0])


def test_only_what_was_trained() -> None:
    """Without offsets, or in a step without a thermal view, nothing happens."""
    gaussians = random_gaussians(3)
    offsets = gaussians.thermal_opacity_offsets.detach().clone()
    shrink_offsets(gaussians, stepped_optimizers(gaussians), 0.0, FINE)
    plain = random_gaussians(3, thermal=False)
    shrink_offsets(plain, stepped_optimizers(plain), 1.0, FINE)
    optimizers = stepped_optimizers(gaussians)
    before = gaussians.thermal_opacity_offsets.detach().clone()
    shrink_offsets(gaussians, optimizers, 1.0, FINE)
    assert torch.equal(gaussians.thermal_opacity_offsets, before)
    assert not torch.equal(offsets, before)  # the optimizers did move them


def test_dropped_offsets_stay_zero() -> None:
    """Offsets that hardly change an opacity become zero; training moves the others only."""
    gaussians = random_gaussians(3)
    optimizers = stepped_optimizers(gaussians)
    offsets = gaussians.thermal_opacity_offsets
    with torch.no_grad():
        gaussians.logit_opacities.copy_(torch.tensor([0.0, 0.0, -7.0]))
        offsets.copy_(torch.tensor([0.04, 1.0, 1.0]))  # opacity changes 0.01, 0.23 and 0.0016
    drop_offsets(gaussians, optimizers, 0.02)
    assert offsets.tolist() == [0.0, 1.0, 0.0]
    for _ in range(3):
        offsets.grad = torch.ones(3)
        hold_zeros(gaussians)
        optimizers["thermal_opacity_offsets"].step()
    assert offsets[[0, 2]].tolist() == [0.0, 0.0]
    assert offsets[1] != 1.0
    plain = random_gaussians(3, thermal=False)
    drop_offsets(plain, stepped_optimizers(plain), 0.02)
    hold_zeros(plain)
