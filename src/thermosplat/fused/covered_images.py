"""Decoded images as far as Gaussians cover them, as a torch function of one Warp kernel: the model's path on CUDA."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.launching import launch
from warp_kernels.training.covered_images import covering_kernels


def warp_covered(decoded: Tensor, alpha: Tensor, base: Tensor | None = None) -> Tensor:
    """``base + alpha * decoded``.

    Args:
        decoded: Image, shape [H, W, C]. Receives a gradient.
        alpha: Accumulated opacities, shape [H, W, 1]. Receives a gradient.
        base: What is added to, shape [H, W, C]; a view with strides is fine. None: nothing. Receives a gradient.
    """
    return _Covered.apply(decoded.contiguous(), alpha.contiguous(), base)


class _Covered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, decoded: Tensor, alpha: Tensor, base: Tensor | None) -> Tensor:
        covered = torch.empty_like(decoded)
        below = decoded[:0] if base is None else base
        with launches_on_torch_stream(decoded.device) as device:
            inputs = [_pixels(decoded), _numbers(alpha), _pixels(below), _pixels(covered)]
            launch(covering_kernels(inputs[0].dtype)[0], alpha.numel(), inputs, device)
        ctx.has_base = base is not None
        ctx.save_for_backward(decoded, alpha)
        return covered

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_covered: Tensor) -> tuple[Tensor | None, ...]:
        decoded, alpha = ctx.saved_tensors
        v_decoded, v_alpha = torch.empty_like(decoded), torch.empty_like(alpha)
        v = v_covered.contiguous()
        with launches_on_torch_stream(decoded.device) as device:
            inputs = [_pixels(decoded), _numbers(alpha), _pixels(v), _pixels(v_decoded), _numbers(v_alpha)]
            launch(covering_kernels(inputs[0].dtype)[1], alpha.numel(), inputs, device)
        return v_decoded, v_alpha, v_covered if ctx.has_base else None


def _pixels(image: Tensor) -> ArrayView:
    return strided_view(image.flatten(0, 1))


def _numbers(image: Tensor) -> ArrayView:
    return strided_view(image.view(-1))
