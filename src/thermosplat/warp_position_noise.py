"""3DGS-MCMC's noise on the means of Gaussians, by one Warp kernel."""

import torch
import warp as wp
from torch import Tensor

from thermosplat.gaussians import Gaussians
from thermosplat.warp_bridge import kinds_of, view
from thermosplat.warp_streams import launches_on_torch_stream
from warp_kernels.position_noise import add_position_noise


@torch.no_grad()
def add_noise_to_means(
    gaussians: Gaussians, normals: Tensor, strength: float, rate: Tensor, gate: tuple[float, float], blocked: Tensor
) -> None:
    """μ += strength · rate · sigmoid(k (t - o)) Σ η, in place, o being the larger opacity. Never waits for the device.

    Args:
        gaussians: The set.
        normals: η, shape [N, 3].
        strength: A factor.
        rate: Another, float32 scalar on the device.
        gate: k and t.
        blocked: float32 scalar; not 0: add nothing.
    """
    second, is_offset = gaussians.stored_thermal_opacities
    logits, kinds = gaussians.logit_opacities, kinds_of(gaussians.means.dtype)
    seconds = logits[:0] if second is None else second
    with launches_on_torch_stream(logits.device):
        add_position_noise(
            view(gaussians.quats, kinds.vec4),
            view(gaussians.log_scales, kinds.vec3),
            view(logits, kinds.scalar),
            view(seconds, kinds.scalar),
            is_offset,
            view(normals, kinds.vec3),
            strength,
            view(rate, wp.float32),
            gate,
            view(blocked, wp.float32),
            view(gaussians.means, kinds.vec3),
        )
