"""What penalties on the Gaussians themselves average: opacities and sizes, from what is stored, and the adjoint.

In place of torch's exponential, two sigmoids, means and their adjoints, each a kernel over all Gaussians.
"""

import functools

import warp as wp

from warp_kernels.activations import opacity_functions
from warp_kernels.coalesced_stores import store_functions
from warp_kernels.coefficient_rows import whole_warps
from warp_kernels.launching import launch


@functools.cache
def penalty_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread a Gaussian.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(penalties, penalties_adjoint)``; the adjoint is launched over ``whole_warps``.
    """
    vec3 = wp.types.vector(3, dtype)
    _, store3, _ = store_functions(dtype)
    sigmoid, sigmoid_adjoint, thermal_opacity = opacity_functions(dtype)
    zero, third = dtype(0.0), dtype(1.0 / 3.0)

    @wp.kernel(name=f"gaussian_penalties_{dtype.__name__}", enable_backward=False, module="unique")
    def penalties_kernel(
        first: int,
        log_scales: wp.array(dtype=vec3),
        logits: wp.array(dtype=dtype),
        seconds: wp.array(dtype=dtype),
        is_offset: bool,
        # outputs
        penalties: wp.array2d(dtype=dtype),
    ):
        gaussian = wp.tid() + first
        logit = logits[gaussian]
        opacity = sigmoid(logit)
        if seconds.shape[0] > 0:
            opacity += thermal_opacity(logit, seconds[gaussian], is_offset)
        log_scale = log_scales[gaussian]
        penalties[0, gaussian] = opacity
        penalties[1, gaussian] = third * (wp.exp(log_scale[0]) + wp.exp(log_scale[1]) + wp.exp(log_scale[2]))

    @wp.kernel(name=f"gaussian_penalties_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def adjoint_kernel(
        first: int,
        log_scales: wp.array(dtype=vec3),
        logits: wp.array(dtype=dtype),
        seconds: wp.array(dtype=dtype),
        is_offset: bool,
        v_penalties: wp.array(dtype=dtype),
        share: dtype,
        # outputs
        v_log_scales: wp.array(dtype=vec3),
        v_logits: wp.array(dtype=dtype),
        v_seconds: wp.array(dtype=dtype),
    ):
        thread = wp.tid() + first
        inside = thread < logits.shape[0]
        gaussian = wp.min(thread, logits.shape[0] - 1)
        v_opacity = share * v_penalties[0]
        v_scale = third * share * v_penalties[1]
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

    return penalties_kernel, adjoint_kernel


def penalties(log_scales: wp.array, logits: wp.array, seconds: wp.array, is_offset: bool, penalties: wp.array) -> None:
    """Computes α + α_t and the mean scale of each Gaussian.

    Args:
        log_scales: vec3 [N], logarithms of the standard deviations [log world units].
        logits: [N], of α.
        seconds: [N], what α_t is computed from; [0]: there is none.
        is_offset: α_t = sigmoid(logit + second); else sigmoid(second).
        penalties: [2, N], output: α + α_t, or α alone; mean of the three standard deviations [world units].
    """
    kernel, _ = penalty_kernels(logits.dtype)
    launch(kernel, len(logits), [log_scales, logits, seconds, is_offset, penalties], logits.device)


def penalties_adjoint(
    log_scales: wp.array,
    logits: wp.array,
    seconds: wp.array,
    is_offset: bool,
    v_penalties: wp.array,
    share: float,
    v_log_scales: wp.array,
    v_logits: wp.array,
    v_seconds: wp.array,
) -> None:
    """The gradients, where every Gaussian's penalties have the same one. They are written, not added to.

    Args:
        log_scales: as in ``penalties``.
        logits: as in ``penalties``.
        seconds: as in ``penalties``.
        is_offset: as in ``penalties``.
        v_penalties: [2].
        share: what ``v_penalties`` are multiplied with: 1 / N where they are of means.
        v_log_scales: vec3 [N], output.
        v_logits: [N], output.
        v_seconds: [N], output; [0] where there are no seconds.
    """
    _, kernel = penalty_kernels(logits.dtype)
    inputs = [
        log_scales,
        logits,
        seconds,
        is_offset,
        v_penalties,
        logits.dtype(share),
        v_log_scales,
        v_logits,
        v_seconds,
    ]
    launch(kernel, whole_warps(len(logits), logits.device), inputs, logits.device)
