"""Contributions are sums of blending weights."""

from typing import Any, Literal

import pytest
import torch

from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.model import SceneModel
from thermosplat.rasterizer import rasterization
from thermosplat.training.contributions import contributions, squared_contributions
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0, "geometric_decoupling": False}


def drawn(model: SceneModel, name: str, chosen: int, capture: Any) -> tuple[float, float]:
    """Sum of the image, by its alpha, that leaves when one Gaussian's colour is black: rendered the long way."""
    gaussians, frame = model.gaussians(name), toy_frame(capture)
    sums = []
    for opacities, view in ((gaussians.opacities, frame.rgb), (gaussians.thermal_opacities, frame.thermal)):
        colors = torch.zeros(len(gaussians), 1)
        colors[chosen] = 1.0
        image, _, _ = rasterization(
            *(gaussians.means, gaussians.quats, gaussians.scales, opacities, colors),
            *(view.viewmat[None], view.K[None], view.width, view.height),
            rasterize_mode=model.config.rasterize_mode,
        )
        sums.append(image.double().sum().item())
    return sums[0], sums[1]


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("aligned", [True, False])
def test_shares_of_blending_weights(aligned: bool, mode: Literal["classic", "antialiased"]) -> None:
    """A Gaussian's share is what is drawn of it alone among the others, in both spectra, as the model draws it."""
    capture = toy_capture(aligned=aligned)
    model = toy_model(toy_config(rasterize_mode=mode), capture)
    with torch.no_grad():
        model.gaussians("shared").log_scales[:30] -= 2.0  # of the size of a pixel
    shares = contributions(model, [toy_frame(capture), toy_frame(capture)])["shared"]
    assert shares.sum().item() == pytest.approx(1.0, abs=1e-5)
    everyone = torch.tensor([drawn(model, "shared", i, capture) for i in range(len(shares))])
    expected = (everyone / everyone.sum(dim=0)).mean(dim=1)
    torch.testing.assert_close(shares, expected.to(shares.dtype), rtol=1e-3, atol=1e-6)


def test_shares_of_squared_weights() -> None:
    """Estimated over many views, shares of squared weights are those of squared images of each Gaussian alone."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    frame = toy_frame(capture)
    gaussians = model.gaussians("shared")
    estimated = squared_contributions(model, [frame] * 300)["shared"]
    images = []
    for opacities in (gaussians.opacities, gaussians.thermal_opacities):
        everyone, _, _ = rasterization(
            *(gaussians.means, gaussians.quats, gaussians.scales, opacities, torch.eye(len(gaussians))),
            *(frame.rgb.viewmat[None], frame.rgb.K[None], frame.rgb.width, frame.rgb.height),
        )
        images.append(everyone.detach().square().sum(dim=(0, 1, 2)))
    expected = torch.stack([image / image.sum() for image in images])
    torch.testing.assert_close(estimated, expected, rtol=0.3, atol=1e-4)
    assert estimated.sum(dim=1).tolist() == pytest.approx([1.0, 1.0], abs=1e-5)


def test_separate_sets_have_shares_of_their_own() -> None:
    """Each set's shares, of its own spectrum, add up to 1; of the other spectrum it has no squared ones."""
    capture = toy_capture()
    model = toy_model(toy_config(**SEPARATE), capture)
    shares = contributions(model, [frame_tensors(capture.train[0], capture.thermal_scale, "cpu")])
    assert {name: round(values.sum().item(), 4) for name, values in shares.items()} == {"rgb": 1.0, "thermal": 1.0}
    squared = squared_contributions(model, [toy_frame(capture)])
    assert not squared["rgb"][1].any()
    assert squared["thermal"].sum(dim=1).tolist() == pytest.approx([0.0, 1.0])
