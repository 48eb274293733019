"""3DGS-MCMC's noise on the means of Gaussians, by one Warp kernel."""

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import launch
from warp_kernels.training.position_noise import noise_kernel


@torch.no_grad()
def add_noise_to_means(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    second_opacities: Tensor | None,
    second_is_offset: bool,
    *,
    normals: Tensor,
    strength: float,
    rate: Tensor,
    gate: tuple[float, float],
    blocked: Tensor,
) -> None:
    """μ += strength · rate · sigmoid(k (t - o)) Σ η, in place, o being the larger opacity. Never waits for the device.

    Args:
        means: [N, 3], to which the noise is added, as the others are stored.
        quats: [N, 4] wxyz.
        log_scales: [N, 3].
        logit_opacities: [N], of α.
        second_opacities: [N]: offsets of those logits, or logits of their own; None: α is all there is.
        second_is_offset: Which of the two.
        normals: η, shape [N, 3].
        rate: Another, float32 scalar on the device.
        gate: k and t.
        blocked: float32 scalar; not 0: add nothing.
    """
    logits, kinds = logit_opacities, kinds_of(means.dtype)
    seconds = logits[:0] if second_opacities is None else second_opacities
    inputs = [
        view(quats, kinds.vec4),
        view(log_scales, kinds.vec3),
        view(logits, kinds.scalar),
        view(seconds, kinds.scalar),
        second_is_offset,
        view(normals, kinds.vec3),
        kinds.scalar(strength),
        view(rate, wp.float32),
        *map(kinds.scalar, gate),
        view(blocked, wp.float32),
        view(means, kinds.vec3),
    ]
    with launches_on_torch_stream(logits.device) as device:
        launch(noise_kernel(kinds.scalar), whole_warps(len(logits), device), inputs, device)
