"""The image loss in Warp as a torch function: the fast path of losses.py on CUDA."""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.ssim import C1, C2, EPSILON, SSIM_SIGMA
from thermosplat.warp_bridge import SCALARS, wrap
from thermosplat.warp_streams import on_torch_stream
from warp_kernels.image_loss_step import ImageLossSettings, image_loss, image_loss_adjoint


def warp_image_loss(render: Tensor, target: Tensor, ssim_lambda: float) -> Tensor:
    """(1 - λ_s) |render - target|_1 + λ_s (1 - SSIM), each the mean over pixels and channels (equation 9).

    The same number and gradient as kornia's filters give in ``losses.image_loss``, to rounding.

    Args:
        render: Rendered image, shape [H, W, C], H and W > 5; a view with strides is fine. Receives a gradient.
        target: Ground truth in [0, 1], shape [H, W, C].
        ssim_lambda: λ_s, the share of the SSIM term, 0 to 1.

    Returns:
        The loss, a scalar.
    """
    return _ImageLoss.apply(render, target, ssim_lambda)


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, render: Tensor, target: Tensor, ssim_lambda: float) -> Tensor:
        height, width, channels = render.shape
        losses = render.new_empty(channels, height, width)
        derivatives = render.new_empty(*((3 * channels, height, width) if ctx.needs_input_grad[0] else (0, 0, 0)))
        ctx.settings = ImageLossSettings(ssim_lambda, SSIM_SIGMA, C1, C2, EPSILON)
        with on_torch_stream(render.device):
            image_loss(_array(render), _array(target), ctx.settings, _array(losses), _array(derivatives))
        ctx.save_for_backward(render, target, derivatives)
        return losses.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor | None, ...]:
        render, target, derivatives = ctx.saved_tensors
        v_render = torch.empty_like(render, memory_format=torch.contiguous_format)
        with on_torch_stream(render.device):
            inputs = (_array(render), _array(target), ctx.settings, _array(derivatives), _array(v_loss.reshape(1)))
            image_loss_adjoint(*inputs, _array(v_render))
        return v_render, None, None


def _array(tensor: Tensor) -> wp.array:
    """A tensor's scalars as a Warp array on the same memory, with the tensor's strides."""
    return wrap(tensor, SCALARS[tensor.dtype])
