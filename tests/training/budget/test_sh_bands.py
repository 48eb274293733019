"""Spherical harmonics that the training images do not miss are dropped, and only those."""

import dataclasses
from typing import Any

import pytest
import torch

from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.sh_bands import cheapest_degrees, color_changes, drop_bands
from toy_scene import toy_capture, toy_config, toy_frame, toy_model


def test_training_images_change_within_the_tolerance() -> None:
    """Some harmonics go, the smaller ones, and the images change, but not more than they may."""
    capture = toy_capture()
    model = toy_model(dataclasses.replace(toy_config(), sh_degree=3), capture)
    frame = toy_frame(capture)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.shN *= torch.logspace(-2, 1, len(gaussians))[:, None, None]
    before = gaussians.shN.detach().clone()
    change = ImageChange(model, [frame], 3)
    drop_bands(model, [frame], 3, change, 1e-3)
    kept = (gaussians.shN != 0).any(dim=-1).sum(dim=1)
    assert 0 < kept.sum() < 0.8 * 15 * len(gaussians)
    assert kept[:20].sum() < kept[-20:].sum()
    assert torch.equal(gaussians.shN[gaussians.shN != 0], before[gaussians.shN != 0])
    assert 0 < change.now() <= 1e-3


@pytest.mark.parametrize("model", [{}, {"feature_dim": 0}])
def test_colors_that_a_spectrum_does_not_show_go_first(model: dict[str, Any]) -> None:
    """Harmonics count in the spectrum whose colours they are, however clear the Gaussian is in the other one."""
    capture = toy_capture()
    scene = toy_model(toy_config(**model), capture)
    gaussians, frame = scene.gaussians("shared"), toy_frame(capture)
    with torch.no_grad():
        gaussians.logit_opacities[:30] = -12.0  # not drawn in RGB
        gaussians.thermal_opacity_offsets[:30] = 14.0
        gaussians.logit_opacities[30:] = 1.0
        gaussians.thermal_opacity_offsets[30:] = -14.0
    change = ImageChange(scene, [frame], 1)
    drop_bands(scene, [frame], 1, change, 0.0)
    assert not gaussians.shN[:30].any()
    assert gaussians.shN[30:].any()
    if model:
        assert gaussians.thermal_shN[:30].any()
        assert not gaussians.thermal_shN[30:].any()
    assert change.now() == 0.0


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize(("feature_dim", "bands"), [(0, ("shN", "thermal_shN", "nir_shN", "red_shN")), (8, ("shN",))])
def test_bands_of_four_spectra(feature_dim: int, bands: tuple[str, ...], aligned: bool) -> None:
    """Each spectrum's harmonics count by its own opacity and cameras; where spectra are decoded, only RGB has any."""
    capture = toy_capture(others=("nir", "red"), aligned=aligned)
    spectra: dict[str, dict[str, Any]] = {"nir": {"opacity": "own"}, "red": {}}
    scene = toy_model(toy_config(feature_dim=feature_dim, spectra=spectra), capture)
    gaussians, frame = scene.gaussians("shared"), toy_frame(capture)
    everyone = torch.arange(60)
    seen = {"rgb": everyone < 20, "thermal": (everyone >= 20) & (everyone < 40), "nir": everyone >= 40}
    logits = {name: torch.where(mask, 1.0, -12.0) for name, mask in seen.items()}
    gaussians.set_opacity_logits(everyone, logits["rgb"], logits)
    change = ImageChange(scene, [frame], 1)
    drop_bands(scene, [frame], 1, change, 0.0)
    assert {name for name, _ in gaussians.named_parameters() if name.endswith("shN")} == set(bands)
    for name, spectrum in zip(bands, ("rgb", "thermal", "nir", "rgb")):  # red shares α with RGB
        values = gaussians.get_parameter(name)
        assert values[seen[spectrum]].any(), name
        assert not values[~seen[spectrum]].any(), name
    assert change.now() == 0.0


def test_zeros_cost_nothing_and_go_first() -> None:
    """Without a tolerance what is zero is all that goes, and nothing changes."""
    capture = toy_capture()
    model = toy_model(dataclasses.replace(toy_config(), sh_degree=2), capture)
    before = model.gaussians("shared").shN.detach().clone()
    change = ImageChange(model, [toy_frame(capture)], 2)
    drop_bands(model, [toy_frame(capture)], 2, change, 0.0)
    assert change.now() == 0.0
    seen = (model.gaussians("shared").shN == before).all(dim=(1, 2))
    assert seen.sum() > 0


def test_color_changes() -> None:
    """Zero above what is zero; unseen Gaussians never change; the full degree changes nothing."""
    capture = toy_capture()
    model = toy_model(dataclasses.replace(toy_config(), sh_degree=2), capture)
    gaussians, view = model.gaussians("shared"), toy_frame(capture).views["rgb"]
    with torch.no_grad():
        gaussians.shN.zero_()
        gaussians.sh0.zero_()
        gaussians.means[:4] = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.2, 0.3, 0.0], [0.0, 0.0, -50.0]])
        gaussians.shN[1, :3] = 0.2
        gaussians.shN[2, 3:] = 0.2
        gaussians.shN[3] = 1.0  # behind the camera
    changes = color_changes(gaussians, gaussians.sh_coeffs, [view, view], 2)
    assert (changes > 1e-4)[:, :4].T.tolist() == [[False] * 3, [True, False, False], [True, True, False], [False] * 3]
    assert not changes[:, 4:].any()
    torch.testing.assert_close(changes, color_changes(gaussians, gaussians.sh_coeffs, [view], 2))  # a mean


def test_cheapest_degrees() -> None:
    """Each keeps the degree of least change and price together; of equal ones the lowest."""
    distortions = torch.tensor([[0.0, 1.0, 9.0], [0.0, 0.9, 4.0], [0.0, 0.0, 0.0]])
    assert cheapest_degrees(distortions, 0.0).tolist() == [0, 2, 2]
    assert cheapest_degrees(distortions, 0.5).tolist() == [0, 0, 2]
    assert cheapest_degrees(distortions, 0.9).tolist() == [0, 0, 1]
    assert cheapest_degrees(distortions, 10.0).tolist() == [0, 0, 0]
