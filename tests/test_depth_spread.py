"""The spread of log-depth along rays: its moments, what it is of blended weights, and whom it moves."""

import math

import pytest
import torch

from thermosplat.depth_spread import NEAREST, depth_spread, log_depth_moments
from thermosplat.rendered_frame import RenderedFrame
from toy_scene import largest_gradients, render, toy_capture, toy_config, toy_frame, toy_model


def test_moments_are_of_the_depth_in_the_camera() -> None:
    """log z and its square; what is before the near plane or behind the camera lies on it, and is not moved."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # z is the world's x
    viewmat[2, 3] = 2.0
    means = torch.tensor([[3.0, 9.0, 9.0], [-1.5, 0.0, 1.0], [-7.0, 1.0, 0.0]], requires_grad=True)
    moments = log_depth_moments(means, viewmat)
    expected = [math.log(5.0), math.log(0.5), math.log(NEAREST)]
    torch.testing.assert_close(moments[:, 0], torch.tensor(expected))
    torch.testing.assert_close(moments[:, 1], torch.tensor(expected).square())
    moments[:, 0].sum().backward()
    torch.testing.assert_close(means.grad, torch.tensor([[0.2, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("limit", [0.0, 0.05])
def test_it_is_half_the_sum_over_pairs(limit: float) -> None:
    """Equation 16, summed over pairs as it is written; any unit of length gives the same."""
    generator = torch.Generator().manual_seed(2)
    weights = torch.rand(2, 3, 4, 7, generator=generator, dtype=torch.float64) / 7
    depths = 1.0 + 9.0 * torch.rand(2, 3, 4, 7, generator=generator, dtype=torch.float64)

    def frame(depths: torch.Tensor) -> RenderedFrame:
        logarithms = depths.log()
        images = torch.stack([(weights * logarithms).sum(-1), (weights * logarithms.square()).sum(-1)], -1)
        alphas = weights.sum(-1)[..., None]
        return RenderedFrame(
            visible_depths=images[0], rgb_alpha=alphas[0], thermal_depths=images[1], thermal_alpha=alphas[1]
        )

    apart = (depths.log()[..., :, None] - depths.log()[..., None, :]).square()
    pairs = 0.5 * (weights[..., :, None] * weights[..., None, :] * apart).sum((-2, -1))
    if limit:
        pairs = pairs * limit / (pairs + limit)
    expected = pairs[0].mean() + pairs[1].mean()
    torch.testing.assert_close(depth_spread(frame(depths), limit), expected)
    torch.testing.assert_close(depth_spread(frame(1000.0 * depths), limit), expected, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("aligned", [True, False])
def test_moments_beside_the_features(aligned: bool) -> None:
    """Images are as without them, by one traversal or a call a spectrum; the spread moves means and both opacities."""
    capture = toy_capture(aligned=aligned)
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    plain, rendered = render(model, frame), render(model, frame, depth_moments=True)
    assert plain.visible_depths is plain.thermal_depths is None
    for name in ("rgb", "thermal", "visible_features", "thermal_features", "thermal_alpha"):
        torch.testing.assert_close(getattr(rendered, name), getattr(plain, name), rtol=1e-5, atol=1e-6)
    for name, moments, alpha in (
        ("rgb", rendered.visible_depths, rendered.rgb_alpha),
        ("thermal", rendered.thermal_depths, rendered.thermal_alpha),
    ):
        first, second = (moments / alpha).unbind(-1)
        spread = (second - first.square()).clamp(min=0)
        # by Jensen the mean of z lies above e to the mean of log z, for such depths about by half the variance
        mean = model.render_depth(name, getattr(frame, name))
        torch.testing.assert_close(mean, first.exp() * (1 + 0.5 * spread), rtol=0.02, atol=0.0)
    gradients = largest_gradients(model, depth_spread(rendered, 0.0))
    moved = {name.rpartition(".")[2] for name, size in gradients.items() if size > 0}
    assert moved == {"means", "quats", "log_scales", "logit_opacities", "thermal_opacity_offsets"}


def test_one_surface_has_no_spread() -> None:
    """All Gaussians at one depth: nothing to penalise, and no gradient beyond rounding."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    with torch.no_grad():
        model.gaussians("shared").means[:, 2] = 1.0
    spread = depth_spread(render(model, frame, depth_moments=True), 0.0)
    assert spread.item() == pytest.approx(0.0, abs=1e-6)
    with torch.no_grad():
        model.gaussians("shared").means[::2, 2] = 4.0
    assert depth_spread(render(model, frame, depth_moments=True), 0.0).item() > 1e-3
