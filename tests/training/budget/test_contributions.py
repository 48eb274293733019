"""Contributions are sums of blending weights."""

from typing import Any

import pytest
import torch

from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.rasterizer import rasterization
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.contributions import contributions, squared_contributions
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}


def drawn(model: SceneModel, name: str, chosen: int, capture: Any) -> list[float]:
    """Sum of each spectrum's image that is drawn of one Gaussian among the others, rendered the long way."""
    gaussians, frame = model.gaussians(name), toy_frame(capture)
    sums = []
    for spectrum, view in frame.views.items():
        opacities = gaussians.opacities_in(spectrum)
        colors = torch.zeros(len(gaussians), 1)
        colors[chosen] = 1.0
        image, _, _ = rasterization(
            *(gaussians.means, gaussians.quats, gaussians.scales, opacities, colors),
            *(view.viewmat[None], view.K[None], view.width, view.height),
            **model.pixel_filter._asdict(),
        )
        sums.append(image.double().sum().item())
    return sums


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("others", [{}, {"nir": {}, "red": {"opacity": "own"}}])
def test_shares_of_blending_weights(others: dict[str, dict[str, Any]], aligned: bool) -> None:
    """A Gaussian's share is what is drawn of it alone among the others, in all spectra, as the model draws it."""
    capture = toy_capture(aligned=aligned, others=tuple(others))
    model = toy_model(toy_config(spectra=others), capture)
    with torch.no_grad():
        model.gaussians("shared").log_scales[:30] -= 2.0  # of the size of a pixel
    shares = contributions(model, [toy_frame(capture), toy_frame(capture)])["shared"]
    assert shares.sum().item() == pytest.approx(1.0, abs=1e-5)
    everyone = torch.tensor([drawn(model, "shared", i, capture) for i in range(len(shares))])
    expected = (everyone / everyone.sum(dim=0)).mean(dim=1)
    torch.testing.assert_close(shares, expected.to(shares.dtype), rtol=1e-3, atol=1e-6)


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
    """Each set's shares, of its own spectrum, add up to 1; of the other spectra it has no squared ones."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {}}, **SEPARATE), capture)
    shares = contributions(model, [frame_tensors(capture.train[0], capture.scales, "cpu")])
    assert {name: round(values.sum().item(), 4) for name, values in shares.items()} == {
        "rgb": 1.0,
        "thermal": 1.0,
        "nir": 1.0,
    }
    squared = squared_contributions(model, [toy_frame(capture)])
    assert not squared["rgb"][1:].any()
    assert squared["thermal"].sum(dim=1).tolist() == pytest.approx([0.0, 1.0, 0.0])
    assert squared["nir"].sum(dim=1).tolist() == pytest.approx([0.0, 0.0, 1.0])


def test_a_spectrum_without_images_counts_for_nothing() -> None:
    """Shares are means over the spectra that frames show; rows of the others are zero."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "offset"}}), capture)
    frame = toy_frame(capture)
    both = contributions(model, [frame.only(("rgb", "thermal")), frame.only(("thermal",))])["shared"]
    assert both.sum().item() == pytest.approx(1.0, abs=1e-5)
    squared = squared_contributions(model, [frame.only(("nir",))])["shared"]
    assert squared.sum(dim=1).tolist() == pytest.approx([0.0, 0.0, 1.0])
