"""Models without features: spherical harmonics for each spectrum, in one set of Gaussians or in two."""

from typing import Any

import pytest
import torch

from thermosplat.scene.model import SceneModel
from toy_scene import count_calls, largest_gradients, render, toy_capture, toy_config, toy_frame, toy_model


def test_separate_sets_are_independent() -> None:
    """Two 3DGS models side by side: no features, no decoders, no gradient across."""
    capture = toy_capture(aligned=False)
    model = toy_model(toy_config(gaussian_sets="separate", feature_dim=0), capture)
    rendered = render(model, toy_frame(capture))
    assert set(model.gaussian_sets) == set(rendered.infos) == {"rgb", "thermal"}
    assert model.formations.decoder is None
    assert rendered.features == {}
    assert rendered.images["thermal"].shape == (14, 16, 3)
    assert model.num_gaussians == 120
    largest = largest_gradients(model, rendered.images["rgb"].square().sum())
    assert largest["gaussian_sets.rgb.means"] > 0.0
    assert largest["gaussian_sets.thermal.means"] == 0.0


def test_one_thermal_channel_from_spherical_harmonics_stays_grey() -> None:
    """A scalar thermal image is the mean of three channels that all get the same gradient."""
    capture = toy_capture(thermal_kind="scalar")
    model = SceneModel.from_capture(toy_config(gaussian_sets="separate", feature_dim=0), capture, "cpu")
    rendered = render(model, toy_frame(capture))
    assert rendered.images["thermal"].shape == (18, 24, 1)
    rendered.images["thermal"].square().sum().backward()
    gradient = model.gaussians("thermal").sh0.grad
    assert gradient.abs().max() > 0
    torch.testing.assert_close(gradient, gradient[..., :1].expand(-1, -1, 3))


def test_plain_3dgs_in_one_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without features a shared set models RGB alone, from its SH colour."""
    calls = count_calls(monkeypatch)
    capture = toy_capture()
    rendered = render(toy_model(toy_config(feature_dim=0, without=("thermal",)), capture), toy_frame(capture))
    assert rendered.images["rgb"].shape == (18, 24, 3)
    assert list(rendered.images) == ["rgb"]
    assert list(rendered.infos) == ["shared"]
    assert calls == ["rasterization"]


SH_PER_SPECTRUM = [
    {"spectra": {"thermal": {"opacity": "shared"}}},
    {},
    {"spectra": {"thermal": {"opacity": "own"}}},
]


@pytest.mark.parametrize("opacity", SH_PER_SPECTRUM)
def test_spherical_harmonics_of_either_spectrum_in_one_traversal(
    opacity: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without features one set renders both spectra from SH of their own; one traversal or two calls are the same."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(feature_dim=0, **opacity), capture)
    calls = count_calls(monkeypatch)
    images, gradient_sets = [], []
    for groups in (None, [["rgb"], ["thermal"]]):
        rendered = render(model, frame, shared_cameras=groups)
        weights = torch.linspace(0, 1, rendered.images["rgb"].numel()).view_as(rendered.images["rgb"])
        model.zero_grad()
        ((rendered.images["rgb"] * weights).sum() + (rendered.images["thermal"].square() * weights).sum()).backward()
        images.append(rendered)
        gradient_sets.append({name: p.grad.clone() for name, p in model.named_parameters()})
    assert calls == ["rasterization_rgbt", "rasterization", "rasterization"]
    assert [info["spectra"] for info in images[1].infos["shared"]] == [("rgb",), ("thermal",)]
    for kind in ("images", "alphas"):
        torch.testing.assert_close(getattr(images[0], kind), getattr(images[1], kind), atol=2e-6, rtol=1e-5)
    for name, gradient in gradient_sets[0].items():
        torch.testing.assert_close(gradient, gradient_sets[1][name], atol=1e-4, rtol=1e-4)
        assert gradient.any(), name
    assert not torch.allclose(images[0].images["rgb"], images[0].images["thermal"])


def test_own_thermal_opacity_is_left_alone_by_rgb() -> None:
    """A stored offset moves with the visible opacity, a logit of its own does not."""
    capture = toy_capture()
    for kind, moves in (("offset", True), ("own", False)):
        model = toy_model(toy_config(feature_dim=0, spectra={"thermal": {"opacity": kind}}), capture)
        gaussians = model.gaussians("shared")
        before = gaussians.opacities_in("thermal").detach().clone()
        with torch.no_grad():
            gaussians.logit_opacities += 1.0
        assert torch.equal(gaussians.opacities_in("thermal"), before) is not moves


def test_scalar_thermal_of_a_shared_set_stays_grey() -> None:
    """One thermal channel from three SH channels that get the same gradient."""
    capture = toy_capture(thermal_kind="scalar")
    model = SceneModel.from_capture(toy_config(feature_dim=0), capture, "cpu")
    rendered = render(model, toy_frame(capture))
    assert rendered.images["thermal"].shape == (18, 24, 1)
    rendered.images["thermal"].square().sum().backward()
    gradient = model.gaussians("shared").thermal_sh0.grad
    assert gradient.abs().max() > 0
    torch.testing.assert_close(gradient, gradient[..., :1].expand(-1, -1, 3))


def test_spherical_harmonics_of_three_spectra(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first two share a traversal, the third has one of its own; a scalar is grey."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(feature_dim=0, spectra={"nir": {"opacity": "own"}}), capture)
    calls = count_calls(monkeypatch)
    rendered = render(model, toy_frame(capture))
    assert calls == ["rasterization_rgbt", "rasterization"]
    assert rendered.images["nir"].shape == (18, 24, 1)
    largest = largest_gradients(model, sum(image.square().sum() for image in rendered.images.values()))
    assert [name for name, value in largest.items() if value == 0.0] == []
    assert {"nir_sh0", "nir_shN", "logit_nir_opacities"} <= set(dict(model.gaussians("shared").named_parameters()))


def test_separate_sets_of_three_spectra() -> None:
    """One set each, rendered by a call each."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(gaussian_sets="separate", feature_dim=0, spectra={"nir": {}}), capture)
    rendered = render(model, toy_frame(capture))
    assert list(model.gaussian_sets) == list(rendered.infos) == ["rgb", "thermal", "nir"]
    assert rendered.images["nir"].shape == (18, 24, 1)
