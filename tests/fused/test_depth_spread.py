"""The spread of log-depth along rays: its moments, what it is of blended weights, and whom it moves."""

import math

import pytest
import torch
from torch import Tensor

from reference_rasterizer import rasterization as reference_rasterization
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.fused.depth_spread import features_and_spread, with_depth_moments
from thermosplat.scene.gaussians import Gaussians
from toy_scene import largest_gradients, render, toy_capture, toy_config, toy_frame, toy_model
from warp_kernels.training.depth_spread import NEAREST

TOLERANCES = {torch.float32: 2e-6, torch.float64: 1e-13}


def test_moments_are_of_the_depth_in_the_camera(device: torch.device) -> None:
    """log z and its square; what is before the near plane or behind the camera lies on it, and is not moved."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # z is the world's x
    viewmat[2, 3] = 2.0
    means = torch.tensor([[3.0, 9.0, 9.0], [-1.5, 0.0, 1.0], [-7.0, 1.0, 0.0]], device=device, requires_grad=True)
    features = torch.arange(6.0, device=device).view(3, 2)
    joined = with_depth_moments(features, means, viewmat.to(device))
    expected = torch.tensor([math.log(5.0), math.log(0.5), math.log(NEAREST)], device=device)
    assert torch.equal(joined[:, :2], features)
    torch.testing.assert_close(joined[:, 2], expected)
    torch.testing.assert_close(joined[:, 3], expected.square())
    joined[:, 2].sum().backward()
    slopes = torch.tensor([[0.2, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]], device=device)
    torch.testing.assert_close(means.grad, slopes)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "channels"), [(0, 8), (1, 1), (77, 8), (5000, 3)])
def test_gradients_of_moments(device: torch.device, count: int, channels: int, dtype: torch.dtype) -> None:
    """Values and gradients against torch in float64, some Gaussians behind the camera."""
    generator = torch.Generator().manual_seed(count)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).to(device)

    features, means, viewmat, upstream = (
        drawn(count, channels),
        drawn(count, 3),
        drawn(4, 4),
        drawn(count, channels + 2),
    )

    def gradients(dtype: torch.dtype, by_torch: bool) -> list[Tensor]:
        leaves = [tensor.to(dtype).requires_grad_() for tensor in (features, means)]
        row = viewmat.to(dtype)
        if by_torch:
            logarithms = (leaves[1] @ row[2, :3] + row[2, 3]).clamp(min=NEAREST).log()
            joined = torch.cat([leaves[0], logarithms[:, None], logarithms[:, None].square()], dim=1)
        else:
            joined = with_depth_moments(*leaves, row)
        return [joined.detach(), *torch.autograd.grad(joined, leaves, upstream.to(dtype))]

    for found, truth in zip(gradients(dtype, False), gradients(torch.float64, True), strict=True):
        assert found.dtype == dtype
        # 1 / z up to 1 / NEAREST multiplies what rounding takes from z
        scale = 1.0 + truth.abs().max().item() if truth.numel() else 1.0
        torch.testing.assert_close(found.double(), truth, rtol=0.0, atol=scale * 50 * TOLERANCES[dtype])


def blended(weights: Tensor, depths: Tensor) -> tuple[Tensor, Tensor]:
    """Image [H, W, 3 + 2] and alpha [H, W, 1] of weights and depths [H, W, layers]; three features beside moments."""
    logarithms = depths.log()
    columns = [weights, 2 * weights, -weights, weights * logarithms, weights * logarithms.square()]
    return torch.stack([column.sum(-1) for column in columns], -1), weights.sum(-1, keepdim=True)


@pytest.mark.parametrize("limit", [0.0, 0.05])
def test_it_is_half_the_sum_over_pairs(device: torch.device, limit: float) -> None:
    """Equation 16, summed over pairs as it is written, and its gradients; any unit of length gives the same."""
    generator = torch.Generator().manual_seed(2)
    weights = (torch.rand(3, 4, 7, generator=generator, dtype=torch.float64) / 7).to(device).requires_grad_()
    depths = (1.0 + 9.0 * torch.rand(3, 4, 7, generator=generator, dtype=torch.float64)).to(device).requires_grad_()
    apart = (depths.log()[..., :, None] - depths.log()[..., None, :]).square()
    pairs = 0.5 * (weights[..., :, None] * weights[..., None, :] * apart).sum((-2, -1))
    expected = (pairs * limit / (pairs + limit) if limit else pairs).mean()
    features, spread = features_and_spread(*blended(weights, depths), limit)
    assert torch.equal(features, blended(weights, depths)[0][..., :3])
    torch.testing.assert_close(spread, expected)
    far = features_and_spread(*blended(weights, 1000.0 * depths), limit)[1]
    torch.testing.assert_close(far, expected, rtol=1e-6, atol=0.0)
    upstream = torch.rand(features.shape, generator=generator, dtype=torch.float64).to(device)
    found = torch.autograd.grad(3.0 * spread + (features * upstream).sum(), [weights, depths])
    loss = 3.0 * expected + (blended(weights, depths)[0][..., :3] * upstream).sum()
    for ours, truth in zip(found, torch.autograd.grad(loss, [weights, depths]), strict=True):
        torch.testing.assert_close(ours, truth)


def test_one_of_both_results_alone(device: torch.device) -> None:
    """Features that nobody uses, or a spread that nobody penalises, have no gradient."""
    image = torch.rand(2, 3, 6, device=device, requires_grad=True)
    alpha = torch.rand(2, 3, 1, device=device, requires_grad=True)
    features, spread = features_and_spread(image, alpha, 0.02)
    (of_image,) = torch.autograd.grad(spread, [image], retain_graph=True)
    assert not of_image[..., :4].any()
    assert of_image[..., 4:].all()
    of_image, of_alpha = torch.autograd.grad(features.sum(), [image, alpha])
    assert (of_image[..., :4] == 1).all()
    assert not of_image[..., 4:].any()
    assert not of_alpha.any()


def reference_spread(gaussians: Gaussians, logits: Tensor, view: ViewTensors) -> Tensor:
    """Mean of (16) over pixels by the dense float64 renderer."""
    means, quats, viewmat = gaussians.means.double(), gaussians.quats.double(), view.viewmat.double()
    logarithms = (means @ viewmat[2, :3] + viewmat[2, 3]).log()
    scene = means, quats, gaussians.log_scales.double().exp(), logits.double().sigmoid()
    moments = torch.stack([logarithms, logarithms.square()], dim=-1)
    camera = viewmat[None], view.K.double()[None], view.width, view.height
    image, alpha, _ = reference_rasterization(*scene, moments, *camera)
    return (alpha[..., 0] * image[..., 1] - image[..., 0].square()).mean()


@pytest.mark.parametrize("aligned", [True, False])
def test_depths_beside_the_features(aligned: bool) -> None:
    """Images are as without them, by one traversal or by several; the spread moves means and both opacities."""
    capture = toy_capture(aligned=aligned)
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    plain, rendered = render(model, frame), render(model, frame, depth_spread_limit=0.0)
    assert plain.depth_spreads == []
    assert len(rendered.depth_spreads) == 2
    for kind in ("images", "features", "alphas"):
        torch.testing.assert_close(getattr(rendered, kind), getattr(plain, kind), rtol=1e-5, atol=1e-6)
    gaussians = model.gaussians("shared")
    for spread, view, logits in zip(
        rendered.depth_spreads,
        (frame.views["rgb"], frame.views["thermal"]),
        (gaussians.logit_opacities, gaussians.logits_in("thermal")),
        strict=True,
    ):
        truth = reference_spread(gaussians, logits, view)
        torch.testing.assert_close(spread.double(), truth, rtol=1e-5, atol=0.0)
    gradients = largest_gradients(model, sum(rendered.depth_spreads))
    moved = {name.rpartition(".")[2] for name, size in gradients.items() if size > 0}
    assert moved == {"means", "quats", "log_scales", "logit_opacities", "thermal_opacity_offsets"}


def test_one_surface_has_no_spread() -> None:
    """All Gaussians at one depth: nothing to penalise beyond rounding."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    with torch.no_grad():
        model.gaussians("shared").means[:, 2] = 1.0
    spreads = render(model, frame, depth_spread_limit=0.0).depth_spreads
    assert [spread.item() for spread in spreads] == pytest.approx([0.0, 0.0], abs=1e-6)
    with torch.no_grad():
        model.gaussians("shared").means[::2, 2] = 4.0
    assert all(spread.item() > 1e-3 for spread in render(model, frame, depth_spread_limit=0.0).depth_spreads)
