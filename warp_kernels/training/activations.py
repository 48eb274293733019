"""Activations of Gaussians: scales = exp(log_scales), opacities = sigmoid(logits), and their adjoint.

Beside its visible opacity α a Gaussian may have a thermal one, α_t. Its *second* number is then an offset of α's
logit, or a logit of α_t's own. A thread a Gaussian reads all that it stores and writes all that the renderer takes;
the adjoint needs nothing but what was written.
"""

import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.loading import made_once


@made_once
def opacity_functions(dtype: type):
    """Opacities from what is stored.

    Returns:
        ``(sigmoid, sigmoid_adjoint, thermal_opacity)``, Warp functions.
    """
    one = dtype(1.0)

    @wp.func
    def sigmoid(x: dtype):
        # exp may overflow: 1 / (1 + inf) is the 0 that it should be
        return one / (one + wp.exp(-x))

    @wp.func
    def sigmoid_adjoint(y: dtype, v: dtype):
        """Gradient v to y = sigmoid(x), passed on to x."""
        return v * (one - y) * y

    @wp.func
    def thermal_opacity(logit: dtype, second: dtype, is_offset: bool):
        """α_t, from α's logit and the second number."""
        return sigmoid(wp.where(is_offset, logit + second, second))

    return sigmoid, sigmoid_adjoint, thermal_opacity


@made_once
def activation_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread per Gaussian.

    Returns:
        ``(activate, activate_adjoint)``, launched over ``whole_warps``.
    """
    vec3 = wp.types.vector(3, dtype)
    _, store3, _ = store_functions(dtype)
    sigmoid, sigmoid_adjoint, thermal_opacity = opacity_functions(dtype)
    zero = dtype(0.0)

    @wp.kernel(name=f"activate_{dtype.__name__}", enable_backward=False, module="unique")
    def activate_kernel(
        first: int,
        log_scales: wp.array(dtype=vec3),  # [N]
        logits: wp.array(dtype=dtype),  # [N]
        seconds: wp.array(dtype=dtype),  # [N]; [0]: there is none
        is_offset: bool,
        # outputs
        scales: wp.array(dtype=vec3),  # [N]
        opacities: wp.array(dtype=dtype),  # [N]
        thermal_opacities: wp.array(dtype=dtype),  # [N]; [0] where there are no seconds
    ):
        thread = wp.tid() + first
        inside = thread < logits.shape[0]
        gaussian = wp.min(thread, logits.shape[0] - 1)
        log_scale = log_scales[gaussian]
        scale = vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
        store3(scales, wp.where(inside, gaussian, -1), scale)
        if inside:
            logit = logits[gaussian]
            opacities[gaussian] = sigmoid(logit)
            if seconds.shape[0] > 0:
                thermal_opacities[gaussian] = thermal_opacity(logit, seconds[gaussian], is_offset)

    @wp.kernel(name=f"activate_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def activate_adjoint_kernel(
        first: int,
        scales: wp.array(dtype=vec3),  # [N]
        opacities: wp.array(dtype=dtype),  # [N]
        thermal_opacities: wp.array(dtype=dtype),  # [N]; [0] where there are no seconds
        v_scales: wp.array(dtype=vec3),  # [N]; [0]: zeros
        v_opacities: wp.array(dtype=dtype),  # [N]; [0]: zeros
        v_thermal_opacities: wp.array(dtype=dtype),  # [N]; [0]: zeros
        is_offset: bool,
        # outputs
        v_log_scales: wp.array(dtype=vec3),  # [N]
        v_logits: wp.array(dtype=dtype),  # [N]
        v_seconds: wp.array(dtype=dtype),  # [N]; [0] where there are no seconds
    ):
        thread = wp.tid() + first
        inside = thread < opacities.shape[0]
        gaussian = wp.min(thread, opacities.shape[0] - 1)
        # gradients that are not given are zero
        v_log_scale, v_logit, v_second = vec3(), zero, zero
        if v_scales.shape[0] > 0:
            v_log_scale = wp.cw_mul(v_scales[gaussian], scales[gaussian])
        store3(v_log_scales, wp.where(inside, gaussian, -1), v_log_scale)
        if inside:
            if v_opacities.shape[0] > 0:
                v_logit = sigmoid_adjoint(opacities[gaussian], v_opacities[gaussian])
            if v_thermal_opacities.shape[0] > 0:
                v_second = sigmoid_adjoint(thermal_opacities[gaussian], v_thermal_opacities[gaussian])
            if is_offset:
                v_logit = v_logit + v_second
            v_logits[gaussian] = v_logit
            if v_seconds.shape[0] > 0:
                v_seconds[gaussian] = v_second

    return activate_kernel, activate_adjoint_kernel
