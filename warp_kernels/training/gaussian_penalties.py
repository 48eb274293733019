"""Mean opacity and size of the Gaussians that a step sees, and the adjoint: what penalties on Gaussians are made of.

In place of torch's exponential, two sigmoids, means and their adjoints, each a kernel over all Gaussians.
"""

import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.lane_sums import total_function
from warp_kernels.machinery.loading import made_once
from warp_kernels.training.activations import opacity_functions


@made_once
def penalty_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread per Gaussian.

    Returns:
        ``(gaussian_means, gaussian_means_adjoint)``, launched over ``whole_warps``.
    """
    vec3 = wp.types.vector(3, dtype)
    _, store3, _ = store_functions(dtype)
    sigmoid, sigmoid_adjoint, thermal_opacity = opacity_functions(dtype)
    warp_total = total_function(dtype)
    zero, third = dtype(0.0), dtype(1.0 / 3.0)

    @wp.kernel(name=f"gaussian_means_{dtype.__name__}", enable_backward=False, module="unique")
    def means_kernel(
        first: int,
        log_scales: wp.array(dtype=vec3),  # [N]
        logits: wp.array(dtype=dtype),  # [N]
        seconds: wp.array(dtype=dtype),  # [N]; [0]: there is none
        seen: wp.array(dtype=wp.bool),  # [N]
        share: wp.array(dtype=dtype),  # [1]
        is_offset: bool,
        lanes: int,
        # outputs
        parts: wp.array2d(dtype=dtype),  # [2, num_warps(N)]
    ):
        thread = wp.tid() + first
        opacity, scale = zero, zero
        if thread < logits.shape[0] and seen[thread]:
            logit = logits[thread]
            opacity = sigmoid(logit)
            if seconds.shape[0] > 0:
                opacity += thermal_opacity(logit, seconds[thread], is_offset)
            log_scale = log_scales[thread]
            scale = third * (wp.exp(log_scale[0]) + wp.exp(log_scale[1]) + wp.exp(log_scale[2]))
        opacity = warp_total(opacity)
        scale = warp_total(scale)
        if thread % lanes == 0:
            parts[0, thread // lanes] = share[0] * opacity
            parts[1, thread // lanes] = share[0] * scale

    @wp.kernel(name=f"gaussian_means_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def adjoint_kernel(
        first: int,
        log_scales: wp.array(dtype=vec3),  # [N]
        logits: wp.array(dtype=dtype),  # [N]
        seconds: wp.array(dtype=dtype),  # [N]; [0]: there is none
        seen: wp.array(dtype=wp.bool),  # [N]
        share: wp.array(dtype=dtype),  # [1]
        is_offset: bool,
        v_means: wp.array(dtype=dtype),  # [2]
        # outputs
        v_log_scales: wp.array(dtype=vec3),  # [N]
        v_logits: wp.array(dtype=dtype),  # [N]
        v_seconds: wp.array(dtype=dtype),  # [N]; [0] where there are no seconds
    ):
        thread = wp.tid() + first
        inside = thread < logits.shape[0]
        gaussian = wp.min(thread, logits.shape[0] - 1)
        weight = wp.where(seen[gaussian], share[0], zero)
        v_opacity = weight * v_means[0]
        v_scale = third * weight * v_means[1]
        log_scale = log_scales[gaussian]
        v_log_scale = v_scale * vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
        store3(v_log_scales, wp.where(inside, gaussian, -1), v_log_scale)
        if inside:
            logit = logits[gaussian]
            v_logit = sigmoid_adjoint(sigmoid(logit), v_opacity)
            if seconds.shape[0] > 0:
                v_second = sigmoid_adjoint(thermal_opacity(logit, seconds[gaussian], is_offset), v_opacity)
                v_seconds[gaussian] = v_second
                v_logit += wp.where(is_offset, v_second, zero)
            v_logits[gaussian] = v_logit

    return means_kernel, adjoint_kernel
