"""How far apart along its ray the Gaussians lie that a pixel is made of, as torch functions of Warp kernels.

Where a surface has no texture, images do not say how opaque it is: Gaussians behind it that have its colour do as well.
2D Gaussian Splatting (Huang et al. 2024, section 4.2, after Mip-NeRF 360) therefore penalises pairs of Gaussians by
their distance, with the weights w of their blending. Here the distance is that of log z, squared:

    A Σ w s² - (Σ w s)² = ½ Σ_i Σ_j w_i w_j (s_i - s_j)²,     s = log z,     A = Σ w                             (16)

A ratio of depths means the same near and far and in any units, and squares need two more channels in place of a pass of
their own.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import given_view, kinds_of, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.lanes import lanes_of, num_warps, whole_warps
from warp_kernels.machinery.launching import launch
from warp_kernels.training.depth_spread import moment_kernels, spread_kernels


def with_depth_moments(features: Tensor, means: Tensor, viewmat: Tensor) -> Tensor:
    """Features beside log z and its square, to be blended together. What is nearer than the near plane counts as there.

    Args:
        features: Shape [N, d]. Receives a gradient.
        means: Centres, shape [N, 3] [world units]. Receives a gradient.
        viewmat: World to camera, shape [4, 4]. Receives none.

    Returns:
        Shape [N, d + 2].
    """
    return _AppendMoments.apply(features.contiguous(), means.contiguous(), viewmat.contiguous())


def features_and_spread(image: Tensor, alpha: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Takes apart what was blended of ``with_depth_moments``.

    Args:
        image: Blended features and moments, shape [H, W, d + 2]. Receives a gradient.
        alpha: Accumulated opacity A of the same Gaussians, shape [H, W, 1]. Receives a gradient.
        limit: Spread from which on more hardly counts, or 0: no limit.

    Returns:
        Blended features, shape [H, W, d]; mean over pixels of v / (1 + v / limit), v being (16), a scalar: zero where
        each pixel sees one depth.
    """
    return _SplitSpread.apply(image.contiguous(), alpha.contiguous(), limit)


class _AppendMoments(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, means: Tensor, viewmat: Tensor) -> Tensor:
        joined = features.new_empty(len(features), features.shape[1] + 2)
        kernel, _ = moment_kernels(kinds_of(features.dtype).scalar, features.shape[1])
        with launches_on_torch_stream(means.device) as device:
            inputs = [strided_view(features), _vec3s(means), strided_view(viewmat), strided_view(joined)]
            launch(kernel, len(features), inputs, device)
        ctx.save_for_backward(means, viewmat)
        return joined

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_joined: Tensor) -> tuple[Tensor | None, ...]:
        means, viewmat = ctx.saved_tensors
        v_features, v_means = v_joined.new_empty(len(means), v_joined.shape[1] - 2), torch.empty_like(means)
        v_joined = v_joined.contiguous()
        _, kernel = moment_kernels(kinds_of(v_joined.dtype).scalar, v_features.shape[1])
        with launches_on_torch_stream(means.device) as device:
            given = _vec3s(means), strided_view(viewmat), strided_view(v_joined)
            launch(kernel, len(means), [*given, strided_view(v_features), _vec3s(v_means)], device)
        return v_features, v_means, None


class _SplitSpread(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, limit: float) -> tuple[Tensor, Tensor]:
        features, count = image.new_empty(*image.shape[:2], image.shape[2] - 2), alpha.numel()
        kernel, _ = spread_kernels(kinds_of(image.dtype).scalar, features.shape[2])
        with launches_on_torch_stream(image.device) as device:
            parts = image.new_empty(num_warps(count, device))
            given = _pixels(image), _numbers(alpha), *_factors(image, limit), lanes_of(device)
            launch(kernel, whole_warps(count, device), [*given, _pixels(features), _numbers(parts)], device)
        ctx.limit = limit
        ctx.save_for_backward(image, alpha)
        return features, parts.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_features: Tensor, v_spread: Tensor) -> tuple[Tensor | None, ...]:
        image, alpha = ctx.saved_tensors
        v_image, v_alpha = torch.empty_like(image), torch.empty_like(alpha)
        v_features = v_features.contiguous()
        _, kernel = spread_kernels(kinds_of(image.dtype).scalar, v_features.shape[2])
        with launches_on_torch_stream(image.device) as device:
            given = _pixels(image), _numbers(alpha), *_factors(image, ctx.limit), _pixels(v_features)
            outputs = _numbers(v_spread), _pixels(v_image), _numbers(v_alpha)
            launch(kernel, alpha.numel(), [*given, *outputs], device)
        return v_image, v_alpha, None


def _vec3s(tensor: Tensor) -> ArrayView:
    return given_view(tensor, kinds_of(tensor.dtype).vec3)


def _pixels(image: Tensor) -> ArrayView:
    return strided_view(image.flatten(0, 1))


def _numbers(tensor: Tensor) -> ArrayView:
    return strided_view(tensor.reshape(-1))


def _factors(image: Tensor, limit: float) -> tuple[Any, Any]:
    """1 / limit, or 0 for none, and a pixel's share of a mean."""
    scalar, count = kinds_of(image.dtype).scalar, image.shape[0] * image.shape[1]
    return scalar(1.0 / limit if limit > 0 else 0.0), scalar(1.0 / max(count, 1))
