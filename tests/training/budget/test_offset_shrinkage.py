"""Offsets step towards zero, and stop there."""

import pytest
import torch

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config import OptimizerConfig
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.offset_shrinkage import (
    drop_offsets,
    hold_zeros,
    idle_offsets,
    offset_spectra,
    shrink_offsets,
    trained_offsets,
)
from thermosplat.training.budget.opacity_sensitivities import offset_effects, opacity_sensitivities
from thermosplat.training.optimizers import gaussian_optimizers
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
    drop_offsets(gaussians, "thermal", optimizers, torch.tensor([True, False, True]))
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
    sensitivities = opacity_sensitivities(model, [frame] * 8, 1, {"thermal": 1.0})["shared"]
    effects = offset_effects(gaussians, "thermal", sensitivities)
    change = ImageChange(model, [frame], 1)
    some = idle_offsets(gaussians, "thermal", effects, change, 1e-4)
    assert torch.equal(gaussians.thermal_opacity_offsets, before)
    assert some[:20].all()
    assert some.sum() < 60
    assert idle_offsets(gaussians, "thermal", effects, change, 1e9).all()
    with torch.no_grad():
        gaussians.thermal_opacity_offsets[some] = 0.0
    assert 0 < change.now() <= 1e-4


def two_of_offsets() -> Gaussians:
    """Three Gaussians with offsets in two spectra, of which near infrared has own logits and blue nothing."""
    gaussians = random_gaussians(3, others={"nir": "own", "red_edge": "offset", "blue": "shared"})
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.copy_(torch.tensor([0.5, -0.02, 0.02]))
        gaussians.red_edge_opacity_offsets.copy_(torch.tensor([-0.5, 0.3, 0.02]))
    return gaussians


def test_offsets_of_every_spectrum_shrink() -> None:
    """All that a step trained; offsets of a spectrum that it did not show, and own logits, stay."""
    gaussians = two_of_offsets()
    assert offset_spectra(gaussians) == ["thermal", "red_edge"]
    optimizers = stepped_optimizers(gaussians)
    before = two_of_offsets()
    for name, value in before.named_parameters():
        gaussians.get_parameter(name).data.copy_(value)
    gaussians.thermal_opacity_offsets.grad = torch.zeros(3)
    gaussians.logit_nir_opacities.grad = torch.zeros(3)
    assert trained_offsets(gaussians) == ["thermal_opacity_offsets"]
    shrink_offsets(gaussians, optimizers, 2.0, FINE)
    assert gaussians.thermal_opacity_offsets.tolist() == pytest.approx([0.4, 0.0, 0.0])
    assert torch.equal(gaussians.red_edge_opacity_offsets, before.red_edge_opacity_offsets)
    gaussians.red_edge_opacity_offsets.grad = torch.zeros(3)
    shrink_offsets(gaussians, optimizers, 2.0, FINE)
    assert gaussians.thermal_opacity_offsets.tolist() == pytest.approx([0.3, 0.0, 0.0])
    assert gaussians.red_edge_opacity_offsets.tolist() == pytest.approx([-0.4, 0.2, 0.0])
    assert torch.equal(gaussians.logit_nir_opacities, before.logit_nir_opacities)


def test_each_spectrum_drops_its_own() -> None:
    """What is dropped in one spectrum is not in another; zeros of each are held."""
    gaussians = two_of_offsets()
    optimizers = stepped_optimizers(gaussians)
    drop_offsets(gaussians, "red_edge", optimizers, torch.tensor([True, False, False]))
    assert (gaussians.red_edge_opacity_offsets == 0).tolist() == [True, False, False]
    assert gaussians.thermal_opacity_offsets.all()
    drop_offsets(gaussians, "thermal", optimizers, torch.tensor([False, True, False]))
    for name in ("thermal_opacity_offsets", "red_edge_opacity_offsets"):
        gaussians.get_parameter(name).grad = torch.ones(3)
    hold_zeros(gaussians)
    assert gaussians.red_edge_opacity_offsets.grad.tolist() == [0.0, 1.0, 1.0]
    assert gaussians.thermal_opacity_offsets.grad.tolist() == [1.0, 0.0, 1.0]


def test_idle_offsets_of_one_spectrum_of_several() -> None:
    """Those that its images do not miss; the other spectrum's offsets are neither tried nor changed."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "offset"}}), capture)
    gaussians, frame = model.gaussians("shared"), toy_frame(capture)
    with torch.no_grad():
        gaussians.nir_opacity_offsets[:20] = 0.0
        gaussians.thermal_opacity_offsets[40:] = 0.0
    before = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
    change = ImageChange(model, [frame], 1)
    sensitivities = opacity_sensitivities(model, [frame] * 8, 1, {"thermal": 1.0, "nir": 1.0})["shared"]
    idle = {
        name: idle_offsets(gaussians, name, offset_effects(gaussians, name, sensitivities), change, 1e-6)
        for name in ("thermal", "nir")
    }
    assert all(torch.equal(value, before[name]) for name, value in gaussians.named_parameters())
    assert idle["nir"][:20].all()
    assert idle["thermal"][40:].all()
    for name, mask in idle.items():
        assert mask.sum() < 60
        drop_offsets(gaussians, name, gaussian_optimizers(gaussians, OptimizerConfig()), mask)
    assert change.now() <= 1e-6
