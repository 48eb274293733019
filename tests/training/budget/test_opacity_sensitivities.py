"""What leaving out a Gaussian, or its opacity in one spectrum, changes in the images."""

from typing import Any

import pytest
import torch

from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.opacity_sensitivities import offset_effects, opacity_sensitivities, removal_effects
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

MANY = 400  # views of random signs


def changes(model: SceneModel, frame: Any, weights: dict[str, float], change: Any) -> torch.Tensor:
    """Weighted squared change of the images by what ``change`` does to each Gaussian alone, the long way."""
    gaussians = model.gaussians(next(iter(model.gaussian_sets)))
    before = model.render(frame.views, sh_degree=1)
    found = []
    for chosen in range(len(gaussians)):
        saved = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
        with torch.no_grad():
            change(gaussians, torch.tensor([chosen]))
            after = model.render(frame.views, sh_degree=1)
            found.append(sum(w * (after.images[m] - before.images[m]).square().sum() for m, w in weights.items()))
            for name, value in saved.items():
                gaussians.get_parameter(name).copy_(value)
    return torch.stack(found)


def leave_out(gaussians: Any, chosen: torch.Tensor) -> None:
    nothing = torch.tensor([-30.0])
    gaussians.set_opacity_logits(chosen, nothing, dict.fromkeys(gaussians.second_opacities, nothing))


def test_removal_effects_are_what_removal_changes() -> None:
    """Of images that are linear in opacities (no decoders), by leaving each out; estimated over many views."""
    capture = toy_capture()
    model = toy_model(toy_config(feature_dim=0), capture)
    gaussians, frame = model.gaussians("shared"), toy_frame(capture)
    with torch.no_grad():
        gaussians.logit_opacities -= 3.0
        gaussians.logit_opacities[7] = 9.0  # opaque: clamped alpha ...
        gaussians.log_scales[7] = 6.0  # ... in every pixel that sees it
        gaussians.means[7, 2] = 2.0  # behind most
    weights = {"rgb": 2.0, "thermal": 5.0}
    before = gaussians.logit_opacities.detach().clone()
    estimated = removal_effects(gaussians, opacity_sensitivities(model, [frame] * MANY, 1, weights)["shared"]) / MANY
    assert torch.equal(gaussians.logit_opacities, before)
    expected = changes(model, frame, weights, leave_out)
    assert expected.max() > 10 * expected.min() > 0
    torch.testing.assert_close(estimated, expected, rtol=0.3, atol=1e-3 * expected.max().item())


def test_offset_effects_are_what_dropping_changes() -> None:
    """Of the thermal image, by giving each Gaussian its visible opacity."""
    capture = toy_capture()
    model = toy_model(toy_config(feature_dim=0), capture)
    gaussians, frame = model.gaussians("shared"), toy_frame(capture)
    with torch.no_grad():
        gaussians.logit_opacities -= 2.0
        gaussians.thermal_opacity_offsets.clamp_(-1.0, 1.0)  # none so faint that most of it is not drawn
    sensitivities = opacity_sensitivities(model, [frame] * MANY, 1, {"thermal": 1.0})["shared"]
    assert not sensitivities[0].any()

    def drop(gaussians: Any, chosen: torch.Tensor) -> None:
        gaussians.thermal_opacity_offsets[chosen] = 0.0

    expected = changes(model, frame, {"thermal": 1.0}, drop)
    estimated = offset_effects(gaussians, "thermal", sensitivities) / MANY
    torch.testing.assert_close(estimated, expected, rtol=0.3, atol=1e-3 * expected.max().item())


def test_offset_effects_of_each_spectrum() -> None:
    """Of three opacities each has a row, in the order of ``second_opacities``, and is dropped in its own images."""
    capture = toy_capture(others=("nir", "red"))
    spectra: dict[str, dict[str, Any]] = {"nir": {"opacity": "offset"}, "red": {"opacity": "own"}}
    model = toy_model(toy_config(feature_dim=0, spectra=spectra), capture)
    gaussians, frame = model.gaussians("shared"), toy_frame(capture)
    assert gaussians.second_opacities == ("thermal", "nir", "red")
    with torch.no_grad():
        gaussians.logit_opacities -= 2.0
        gaussians.logit_red_opacities -= 2.0
        gaussians.thermal_opacity_offsets.clamp_(-1.0, 1.0)
        gaussians.nir_opacity_offsets.clamp_(-1.0, 1.0)
    weights = {"thermal": 1.0, "nir": 3.0}
    sensitivities = opacity_sensitivities(model, [frame] * MANY, 1, weights)["shared"]
    assert sensitivities.shape == (4, 60)
    assert sensitivities[0].max() < 1e-9 * sensitivities[1:3].max()  # α's logit moves both: their sum less either
    assert sensitivities[1:].any(dim=1).tolist() == [True, True, False]
    for name, weight in weights.items():

        def drop(gaussians: Any, chosen: torch.Tensor, name: str = name) -> None:
            gaussians.get_parameter(f"{name}_opacity_offsets")[chosen] = 0.0

        expected = changes(model, frame, {name: weight}, drop)
        estimated = offset_effects(gaussians, name, sensitivities) / MANY
        torch.testing.assert_close(estimated, expected, rtol=0.3, atol=1e-3 * expected.max().item())


@pytest.mark.rotating
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"spectra": {"thermal": {"opacity": "own"}}},
        {"spectra": {"thermal": {"opacity": "shared"}}},
        {"gaussian_sets": "separate", "feature_dim": 0},
        {"spectra": {"nir": {}}},
        {"spectra": {"nir": {"opacity": "own"}}},
        {"spectra": {"thermal": {"opacity": "own"}, "nir": {"opacity": "offset"}}, "feature_dim": 0},
        {"gaussian_sets": "separate", "feature_dim": 0, "spectra": {"nir": {}}},
    ],
)
def test_every_kind_of_model_has_them(settings: dict[str, Any]) -> None:
    """Decoded features, one opacity or two however they are stored, separate sets: they rank as removal does."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(**settings), capture)
    frame = toy_frame(capture)
    weights = dict.fromkeys(model.spectra, 1.0)
    found = opacity_sensitivities(model, [frame] * 100, 1, weights)
    assert set(found) == set(model.gaussian_sets)
    for name, rows in found.items():
        assert len(rows) == 1 + len(model.gaussians(name).second_opacities)
    name = next(iter(found))
    estimated = removal_effects(model.gaussians(name), found[name])
    expected = changes(model, frame, weights if name == "shared" else {name: 1.0}, leave_out)
    ranks = torch.stack([values.argsort().argsort().float() for values in (estimated, expected)])
    assert torch.corrcoef(ranks)[0, 1] > 0.9
