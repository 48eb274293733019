"""The Gaussians in view give the images and gradients that all of them give."""

import dataclasses
import math
from typing import Any

import pytest
import torch

from thermosplat.datasets.frame_tensors import FrameTensors, frame_tensors
from thermosplat.scene import offloaded as subject
from thermosplat.scene.model import SceneModel
from thermosplat.scene.offloaded import GaussiansInView, OffloadedParameter, indices_in_view, offload, stored_values
from thermosplat.scene.pixel_filter import PixelFilter
from toy_scene import toy_capture, toy_config, toy_model

MODELS: dict[str, dict[str, Any]] = {
    "offsets": {},
    "narrow footprints": {"eps2d": 0.05},
    "own opacity": {"spectra": {"thermal": {"opacity": "own"}}},
    "no features": {"feature_dim": 0},
    "separate": {"gaussian_sets": "separate", "feature_dim": 0},
}


def scene(device: torch.device, aligned: bool, **model: Any) -> tuple[SceneModel, FrameTensors]:
    """A model of which a third lies behind the cameras, and the frame."""
    capture = toy_capture(aligned=aligned)
    made = toy_model(toy_config(**model), capture)
    with torch.no_grad():
        for name in made.gaussian_sets:
            made.gaussians(name).means[::3, 2] -= 20.0
    return made.to(device), frame_tensors(capture.train[0], capture.scales, device)


def differentiated(model: SceneModel, frame: FrameTensors, sh_degree: int) -> tuple[list[torch.Tensor], Any]:
    """Images after a backward pass, and what was rendered."""
    rendered = model.render(frame.views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras)
    images = [rendered.images[name] for name in model.spectra]
    sum(image.square().mean() for image in images).backward()
    return images, rendered


@pytest.mark.parametrize("parameters", [True, False])
@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("config", MODELS.values(), ids=MODELS)
def test_same_images_and_gradients(
    device: torch.device, config: dict[str, Any], aligned: bool, parameters: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All models, by one traversal or a call per spectrum: rows have their gradients, and no parameter of them."""
    monkeypatch.setattr(subject, "PROJECTED_AT_ONCE", 7)
    whole, frame = scene(device, aligned, **config)
    some, _ = scene(device, aligned, **config)
    for name in some.gaussian_sets:
        offload(some.gaussians(name), device, parameters=parameters)
    images, _ = differentiated(whole, frame, 1)
    found, rendered = differentiated(some, frame, 1)
    tolerance = {"rtol": 1e-5, "atol": 1e-6} if device.type == "cpu" else {"rtol": 1e-4, "atol": 1e-5}
    for image, reference in zip(found, images, strict=True):
        torch.testing.assert_close(image, reference, **tolerance)
    for name in whole.gaussian_sets:
        in_view = rendered.in_view[name]
        assert 10 <= len(in_view) <= 40
        for key, reference in whole.gaussians(name).named_parameters():
            parameter = some.gaussians(name).get_parameter(key)
            if isinstance(parameter, OffloadedParameter):
                assert parameter.grad is None
                gradient = torch.zeros_like(reference)
                if in_view.rows[key].grad is not None:
                    gradient[in_view.indices] = in_view.rows[key].grad
            else:
                gradient = torch.zeros_like(reference) if parameter.grad is None else parameter.grad
            expected = torch.zeros_like(reference) if reference.grad is None else reference.grad
            torch.testing.assert_close(gradient, expected, **tolerance)


def test_coefficients_in_use_are_fetched(device: torch.device) -> None:
    """At degree 0 no spherical harmonics come along, and the images are those of degree 0."""
    whole, frame = scene(device, True)
    some, _ = scene(device, True)
    offload(some.gaussians("shared"), device, parameters=True)
    images, _ = differentiated(whole, frame, 0)
    found, rendered = differentiated(some, frame, 0)
    in_view = rendered.in_view["shared"]
    assert in_view.rows["shN"].shape == (len(in_view), 0, 3)
    assert in_view.rows["features"].shape == (len(in_view), 8)
    for image, reference in zip(found, images, strict=True):
        torch.testing.assert_close(image, reference, rtol=1e-4, atol=1e-5)


def test_in_view_of_any_camera(device: torch.device) -> None:
    """Of two cameras that look to two sides, the Gaussians of both; their numbers ascend, and none is behind."""
    model, frame = scene(device, True)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.log_scales -= 3.0
    view = frame.views["rgb"]
    turned = []
    for angle in (-0.6, 0.6):
        viewmat = view.viewmat.clone()
        turn = [[math.cos(angle), 0.0, math.sin(angle)], [0.0, 1.0, 0.0], [-math.sin(angle), 0.0, math.cos(angle)]]
        viewmat[:3] = torch.tensor(turn, device=device) @ viewmat[:3]
        turned.append(dataclasses.replace(view, viewmat=viewmat))
    one, two = (indices_in_view(gaussians, [camera], PixelFilter()) for camera in turned)
    both = indices_in_view(gaussians, turned, PixelFilter())
    assert both.tolist() == sorted({*one.tolist(), *two.tolist()})
    assert min(len(one), len(two)) < len(both) < len(gaussians)
    assert not (both % 3 == 0).any()


def test_nothing_in_view(device: torch.device) -> None:
    """A frame that sees no Gaussian is black, and its backward pass leaves no gradient."""
    model, frame = scene(device, True)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.means[:, 2] -= 100.0
    offload(gaussians, device, parameters=True)
    images, rendered = differentiated(model, frame, 1)
    assert len(rendered.in_view["shared"]) == 0
    assert not images[0].any()
    assert gaussians.means.grad is None or not gaussians.means.grad.any()


def test_without_gradients_rows_have_none(device: torch.device) -> None:
    """Evaluation fetches rows that nothing is recorded for; a set that is not rendered is not searched."""
    model, frame = scene(device, False, gaussian_sets="separate", feature_dim=0)
    for name in model.gaussian_sets:
        offload(model.gaussians(name), device, parameters=True)
    with torch.no_grad():
        rendered = model.render({"rgb": frame.views["rgb"]}, sh_degree=1)
    assert rendered.in_view.keys() == {"rgb"}
    assert isinstance(rendered.in_view["rgb"], GaussiansInView)
    assert not rendered.in_view["rgb"].rows["shN"].requires_grad


def test_stored_values_are_the_whole_set(device: torch.device) -> None:
    """A checkpoint's parameters are those of a set that was not offloaded; what lies on the host comes from there."""
    whole, _ = scene(device, True)
    some, _ = scene(device, True)
    gaussians = some.gaussians("shared")
    offload(gaussians, device, parameters=True)
    assert {type(gaussians.get_parameter(name)) for name in ("shN", "features")} == {OffloadedParameter}
    stored = stored_values(gaussians)
    assert stored["shN"].device.type == "cpu"
    for name, value in whole.gaussians("shared").state_dict().items():
        assert torch.equal(stored[name].cpu(), value.cpu())
