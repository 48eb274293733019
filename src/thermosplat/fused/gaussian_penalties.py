"""Mean opacity and size of Gaussians as a torch function of one Warp kernel each way."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import given_view, kinds_of, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.lanes import num_warps
from warp_kernels.training.gaussian_penalties import gaussian_means, gaussian_means_adjoint


def mean_opacity_and_scale(
    log_scales: Tensor, logit_opacities: Tensor, stored_thermal: Tensor | None, is_offset: bool
) -> tuple[Tensor, Tensor]:
    """Means over all Gaussians.

    Args:
        log_scales: Logarithms of the standard deviations along the axes [log world units], shape [N, 3], N > 0.
            Receives a gradient, as the others do.
        logit_opacities: Logits of the visible opacity α, shape [N].
        stored_thermal: What the thermal opacity α_t is computed from, shape [N]; None: there is one opacity.
        is_offset: α_t is sigmoid(logit α + stored), otherwise sigmoid(stored).

    Returns:
        The mean of α, plus that of α_t where there are two; the mean standard deviation [world units]. Scalars.
    """
    means = _Means.apply(log_scales.contiguous(), logit_opacities.contiguous(), stored_thermal, is_offset)
    return means.unbind()


class _Means(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, second: Tensor | None, is_offset: bool) -> Tensor:
        stored = log_scales, logits, logits[:0] if second is None else second
        with launches_on_torch_stream(logits.device) as device:
            parts = logits.new_empty(2, num_warps(len(logits), device))
            gaussian_means(*_arrays(*stored), is_offset, strided_view(parts))
        ctx.is_offset = is_offset
        ctx.save_for_backward(*stored)
        return parts.sum(dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_means: Tensor) -> tuple[Tensor | None, ...]:
        stored = ctx.saved_tensors
        v_stored = [torch.empty_like(tensor) for tensor in stored]
        v = v_means.contiguous()
        with launches_on_torch_stream(v.device):
            gaussian_means_adjoint(*_arrays(*stored), ctx.is_offset, strided_view(v), *_arrays(*v_stored))
        v_log_scales, v_logits, v_second = v_stored
        return v_log_scales, v_logits, v_second if ctx.needs_input_grad[2] else None, None


def _arrays(log_scales: Tensor, logits: Tensor, seconds: Tensor) -> tuple[ArrayView, ...]:
    """What is stored, or gradients to it, as the kernels take them."""
    return given_view(log_scales, kinds_of(log_scales.dtype).vec3), strided_view(logits), strided_view(seconds)
