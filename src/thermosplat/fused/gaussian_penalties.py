"""Mean opacity and size of the Gaussians that are seen as a torch function of one Warp kernel each way."""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import given_view, kinds_of, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.lanes import lanes_of, num_warps, whole_warps
from warp_kernels.machinery.launching import launch
from warp_kernels.training.gaussian_penalties import penalty_kernels


def mean_opacity_and_scale(
    log_scales: Tensor,
    logit_opacities: Tensor,
    stored_thermal: Tensor | None,
    is_offset: bool,
    seen: Tensor,
    number: Tensor,
) -> tuple[Tensor, Tensor]:
    """Sums over the Gaussians that are seen, divided by a number: of one process alone, their means.

    Args:
        log_scales: Logarithms of the standard deviations along the axes [log world units], shape [N, 3], N > 0.
            Receives a gradient, as the others do.
        logit_opacities: Logits of the visible opacity α, shape [N].
        stored_thermal: What the thermal opacity α_t is computed from, shape [N]; None: there is one opacity.
        is_offset: α_t is sigmoid(logit α + stored), otherwise sigmoid(stored).
        seen: bool, shape [N].
        number: What sums are divided by: how many Gaussians are seen, those of other processes, too. Scalar.

    Returns:
        The mean of α, plus that of α_t where there are two; the mean standard deviation [world units]. Scalars.
    """
    share = number.to(logit_opacities.dtype).clamp(min=1.0).reciprocal().reshape(1)
    stored = log_scales.contiguous(), logit_opacities.contiguous(), stored_thermal
    means = _Means.apply(*stored, is_offset, seen.contiguous(), share)
    return means.unbind()


class _Means(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        log_scales: Tensor,
        logits: Tensor,
        second: Tensor | None,
        is_offset: bool,
        seen: Tensor,
        share: Tensor,
    ) -> Tensor:
        stored = log_scales, logits, logits[:0] if second is None else second
        kernel, _ = penalty_kernels(kinds_of(logits.dtype).scalar)
        with launches_on_torch_stream(logits.device) as device:
            parts = logits.new_empty(2, num_warps(len(logits), device))
            given = *_arrays(*stored), *_those_seen(seen, share), is_offset, lanes_of(device)
            launch(kernel, whole_warps(len(logits), device), [*given, strided_view(parts)], device)
        ctx.is_offset = is_offset
        ctx.save_for_backward(*stored, seen, share)
        return parts.sum(dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_means: Tensor) -> tuple[Tensor | None, ...]:
        *stored, seen, share = ctx.saved_tensors
        v_stored = [torch.empty_like(tensor) for tensor in stored]
        v = v_means.contiguous()
        logits = stored[1]
        _, kernel = penalty_kernels(kinds_of(logits.dtype).scalar)
        with launches_on_torch_stream(v.device) as device:
            given = *_arrays(*stored), *_those_seen(seen, share), ctx.is_offset, strided_view(v)
            launch(kernel, whole_warps(len(logits), device), [*given, *_arrays(*v_stored)], device)
        v_log_scales, v_logits, v_second = v_stored
        return v_log_scales, v_logits, v_second if ctx.needs_input_grad[2] else None, None, None, None


def _arrays(log_scales: Tensor, logits: Tensor, seconds: Tensor) -> tuple[ArrayView, ...]:
    """What is stored, or gradients to it, as the kernels take them."""
    return given_view(log_scales, kinds_of(log_scales.dtype).vec3), strided_view(logits), strided_view(seconds)


def _those_seen(seen: Tensor, share: Tensor) -> tuple[ArrayView, ArrayView]:
    return given_view(seen, wp.bool), strided_view(share)
