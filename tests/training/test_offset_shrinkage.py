"""Offsets step towards zero, and stop there."""

import pytest
import torch
from random_gaussians import random_gaussians, stepped_optimizers

from thermosplat.training.image_change import ImageChange
from thermosplat.training.offset_shrinkage import drop_offsets, hold_zeros, idle_offsets, shrink_offsets
from thermosplat.training.opacity_sensitivities import offset_effects, opacity_sensitivities
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

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
    """Training moves the others only."""
    gaussians = random_gaussians(3)
    optimizers = stepped_optimizers(gaussians)
    offsets = gaussians.thermal_opacity_offsets
    with torch.no_grad():
        offsets.copy_(torch.tensor([0.04, 1.0, 1.0]))
    drop_offsets(gaussians, optimizers, torch.tensor([True, False, True]))
    assert offsets.tolist() == [0.0, 1.0, 0.0]
    for _ in range(3):
        offsets.grad = torch.ones(3)
        hold_zeros(gaussians)
        optimizers["thermal_opacity_offsets"].step()
    assert offsets[[0, 2]].tolist() == [0.0, 0.0]
    assert offsets[1] != 1.0
    plain = random_gaussians(3, thermal=False)
    hold_zeros(plain)


def test_idle_offsets_are_those_that_images_do_not_miss() -> None:
    """The most that change the images within the tolerance, of least effect; none without a tolerance, all with any."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    gaussians, frame = model.gaussians("shared"), toy_frame(capture)
    with torch.no_grad():
        gaussians.thermal_opacity_offsets[:20] *= 0.01
    before = gaussians.thermal_opacity_offsets.detach().clone()
    effects = offset_effects(gaussians, opacity_sensitivities(model, [frame] * 8, 1, {"thermal": 1.0})["shared"])
    change = ImageChange(model, [frame], 1)
    some = idle_offsets(gaussians, effects, change, 1e-4)
    assert torch.equal(gaussians.thermal_opacity_offsets, before)
    assert some[:20].all()
    assert some.sum() < 60
    assert idle_offsets(gaussians, effects, change, 1e9).all()
    with torch.no_grad():
        gaussians.thermal_opacity_offsets[some] = 0.0
    assert 0 < change.now() <= 1e-4
