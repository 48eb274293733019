"""Gaussians seen from a view: the same whichever way their activations are computed."""

from typing import Any

import pytest
import torch

from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.scene import views as gaussian_views
from toy_scene import render, toy_capture, toy_config, toy_model

MODELS = {
    "offsets": {},
    "own opacity": {"spectra": {"thermal": {"opacity": "own"}}},
    "one opacity": {"spectra": {"thermal": {"opacity": "shared"}}},
    "no features": {"feature_dim": 0},
    "no features, one opacity": {"feature_dim": 0, "spectra": {"thermal": {"opacity": "shared"}}},
    "separate": {"gaussian_sets": "separate", "feature_dim": 0},
    "rgb": {"without": ("thermal",)},
}


@pytest.mark.parametrize("model_config", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("aligned", [True, False])
def test_one_kernel_for_the_activations_changes_nothing(
    device: torch.device, model_config: dict[str, Any], aligned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images, depths and parameters' gradients of all kinds of model, by one traversal or one call per spectrum."""
    capture = toy_capture(aligned=aligned)
    frame = frame_tensors(capture.train[0], capture.scales, device)
    model = toy_model(toy_config(**model_config), capture).to(device)
    spectra = list(model.spectra)
    results, gradients = [], []
    for by_one_kernel in (True, False):
        monkeypatch.setattr(gaussian_views, "activated_by_one_kernel", lambda _, chosen=by_one_kernel: chosen)
        rendered = render(model, frame)
        depths = [model.render_depth(name, frame.views[name], expected=True) for name in spectra]
        results.append([rendered.images[name] for name in spectra] + depths)
        model.zero_grad()
        sum(image.square().mean() for image in results[-1]).backward()
        gradients.append([parameter.grad for parameter in model.parameters()])
    for value, reference in zip(*results, strict=True):
        torch.testing.assert_close(value, reference, rtol=1e-5, atol=1e-5)
    for value, reference in zip(*gradients, strict=True):
        if reference is None:
            assert value is None or not value.any()
        else:
            torch.testing.assert_close(value, reference, rtol=1e-3, atol=1e-5)


def test_activations_are_one_kernel_on_cuda(device: torch.device) -> None:
    """Torch's own are used on the CPU alone, where they are vectorised."""
    gaussians = toy_model(toy_config(), toy_capture()).gaussians("shared").to(device)
    assert gaussian_views.activated_by_one_kernel(gaussians) == (device.type == "cuda")
