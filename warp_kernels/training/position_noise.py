"""Noise on Gaussians' means: 3DGS-MCMC's step beside the optimizer's, in one pass over the Gaussians."""

import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.rotation import rotation_functions
from warp_kernels.training.activations import opacity_functions


@made_once
def noise_kernel(dtype: type) -> wp.Kernel:
    """One thread a Gaussian, launched over ``whole_warps``."""
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    _, store3, _ = store_functions(dtype)
    sigmoid, _, thermal_opacity = opacity_functions(dtype)
    to_matrix, _ = rotation_functions(dtype)

    @wp.kernel(name=f"add_position_noise_{dtype.__name__}", enable_backward=False, module="unique")
    def add_noise_kernel(
        first: int,
        quats: wp.array(dtype=vec4),  # [N]
        log_scales: wp.array(dtype=vec3),  # [N]
        logits: wp.array(dtype=dtype),  # [N]
        seconds: wp.array(dtype=dtype),  # [N]; [0]: there is none
        is_offset: bool,
        normals: wp.array(dtype=vec3),  # [N]
        strength: dtype,
        rate: wp.array(dtype=wp.float32),  # [1]
        steepness: dtype,
        threshold: dtype,
        blocked: wp.array(dtype=wp.float32),  # [1]
        # inputs and outputs
        means: wp.array(dtype=vec3),  # [N]
    ):
        if blocked[0] != 0.0:
            return
        thread = wp.tid() + first
        inside = thread < logits.shape[0]
        gaussian = wp.min(thread, logits.shape[0] - 1)
        logit = logits[gaussian]
        opacity = sigmoid(logit)
        if seconds.shape[0] > 0:
            opacity = wp.max(opacity, thermal_opacity(logit, seconds[gaussian], is_offset))
        gate = sigmoid(steepness * (threshold - opacity))
        # Σ η = R S² Rᵀ η
        R = to_matrix(quats[gaussian])
        log_scale, normal = log_scales[gaussian], normals[gaussian]
        within = wp.transpose(R) * wp.vec3d(wp.float64(normal[0]), wp.float64(normal[1]), wp.float64(normal[2]))
        for k in range(3):
            scale = wp.float64(wp.exp(log_scale[k]))
            within[k] = scale * scale * within[k]
        moved = wp.float64(strength * dtype(rate[0]) * gate) * (R * within)
        mean = means[gaussian] + vec3(dtype(moved[0]), dtype(moved[1]), dtype(moved[2]))
        store3(means, wp.where(inside, gaussian, -1), mean)

    return add_noise_kernel
