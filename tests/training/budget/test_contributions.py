"""Contributions are sums of squared blending weights."""

import pytest
import torch

from thermosplat.rasterizer import rasterization
from thermosplat.training.budget.contributions import squared_contributions
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}


def test_shares_of_squared_weights() -> None:
    """Estimated over many views, shares of squared weights are those of squared images of each Gaussian alone."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "own"}}), capture)
    frame = toy_frame(capture)
    gaussians = model.gaussians("shared")
    estimated = squared_contributions(model, [frame] * 300)["shared"]
    images = []
    for name, view in frame.views.items():
        opacities = gaussians.opacities_in(name)
        everyone, _, _ = rasterization(
            *(gaussians.means, gaussians.quats, gaussians.scales, opacities, torch.eye(len(gaussians))),
            *(view.viewmat[None], view.K[None], view.width, view.height),
        )
        images.append(everyone.detach().square().sum(dim=(0, 1, 2)))
    expected = torch.stack([image / image.sum() for image in images])
    torch.testing.assert_close(estimated, expected, rtol=0.3, atol=1e-4)
    assert estimated.sum(dim=1).tolist() == pytest.approx([1.0, 1.0, 1.0], abs=1e-5)


def test_separate_sets_have_shares_of_their_own() -> None:
    """Each set's shares, of its own spectrum, add up to 1; of the other spectra it has none."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {}}, **SEPARATE), capture)
    squared = squared_contributions(model, [toy_frame(capture)])
    assert squared["rgb"].sum(dim=1).tolist() == pytest.approx([1.0, 0.0, 0.0])
    assert squared["thermal"].sum(dim=1).tolist() == pytest.approx([0.0, 1.0, 0.0])
    assert squared["nir"].sum(dim=1).tolist() == pytest.approx([0.0, 0.0, 1.0])


def test_a_spectrum_without_images_counts_for_nothing() -> None:
    """Rows of spectra that no frame shows are zero."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "offset"}}), capture)
    frame = toy_frame(capture)
    squared = squared_contributions(model, [frame.only(("nir",))])["shared"]
    assert squared.sum(dim=1).tolist() == pytest.approx([0.0, 0.0, 1.0])
