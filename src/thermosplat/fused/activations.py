"""Activations of Gaussians as a torch function of one Warp kernel: what a captured step on CUDA renders with."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import given_view, kinds_of, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import launch
from warp_kernels.training.activations import activation_kernels


def activated(
    log_scales: Tensor, logit_opacities: Tensor, stored_thermal: Tensor | None = None, is_offset: bool = False
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Scales and opacities of Gaussians from what they store.

    Args:
        log_scales: Logarithms of the standard deviations along the axes [log world units], shape [N, 3]. Receives a
            gradient, as the others do.
        logit_opacities: Logits of the visible opacity α, shape [N].
        stored_thermal: What the thermal opacity α_t is computed from, shape [N]; None: there is one opacity.
        is_offset: α_t is sigmoid(logit α + stored), otherwise sigmoid(stored).

    Returns:
        Scales exp(log_scales) [world units], [N, 3]; α in [0, 1], [N]; α_t in [0, 1], [N], or None with
        one opacity. A gradient that one of them does not get counts as zero.
    """
    return _Activated.apply(log_scales.contiguous(), logit_opacities, stored_thermal, is_offset)


class _Activated(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, log_scales: Tensor, logits: Tensor, second: Tensor | None, is_offset: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        stored = log_scales, logits, logits[:0] if second is None else second
        made = [torch.empty_like(tensor) for tensor in stored]
        kernel, _ = activation_kernels(kinds_of(logits.dtype).scalar)
        with launches_on_torch_stream(logits.device) as device:
            launch(kernel, whole_warps(len(logits), device), [*_arrays(*stored), is_offset, *_arrays(*made)], device)
        ctx.is_offset = is_offset
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*made)
        scales, opacities, thermal_opacities = made
        return scales, opacities, None if second is None else thermal_opacities

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        made = ctx.saved_tensors
        given = [tensor[:0] if v is None else v for tensor, v in zip(made, gradients, strict=True)]
        v_stored = [torch.empty_like(tensor) for tensor in made]
        _, kernel = activation_kernels(kinds_of(made[1].dtype).scalar)
        with launches_on_torch_stream(made[0].device) as device:
            inputs = [*_arrays(*made), *_arrays(*given), ctx.is_offset, *_arrays(*v_stored)]
            launch(kernel, whole_warps(len(made[1]), device), inputs, device)
        v_log_scales, v_logits, v_second = v_stored
        return v_log_scales, v_logits, v_second if ctx.needs_input_grad[2] else None, None


def _arrays(scales: Tensor, opacities: Tensor, thermal_opacities: Tensor) -> tuple[ArrayView, ...]:
    """Numbers of all three, before or after their activation, or gradients to them, as the kernels take them."""
    vec3 = kinds_of(scales.dtype).vec3
    return given_view(scales, vec3), strided_view(opacities), strided_view(thermal_opacities)
