"""Adam's update of the rows that were visible, without correction of bias: Taming 3DGS's, as gsplat has it."""

import warp as wp

from warp_kernels.machinery.launching import launch
from warp_kernels.machinery.loading import made_once


@made_once
def selective_adam_kernel(dtype: type) -> wp.Kernel:
    """The kernel, one thread a number."""

    @wp.kernel(name=f"selective_adam_{dtype.__name__}", enable_backward=False, module="unique")
    def update_visible_rows(
        first: int,
        length: int,
        rate: dtype,
        share1: dtype,
        share2: dtype,
        epsilon: dtype,
        visible: wp.array(dtype=wp.bool),  # [N]
        gradients: wp.array(dtype=dtype),  # [N · length]
        # inputs and outputs
        parameters: wp.array(dtype=dtype),  # [N · length]
        exp_avgs: wp.array(dtype=dtype),  # [N · length]
        exp_avg_sqs: wp.array(dtype=dtype),  # [N · length]
    ):
        """m ← m + (1 - β1) (g - m), v ← v + (1 - β2) (g² - v), p ← p - rate · m / (√v + ε)."""
        number = wp.tid() + first
        if visible[number / length]:
            g = gradients[number]
            m = exp_avgs[number]
            v = exp_avg_sqs[number]
            m += share1 * (g - m)
            v += share2 * (g * g - v)
            exp_avgs[number] = m
            exp_avg_sqs[number] = v
            parameters[number] = parameters[number] - rate * m / (wp.sqrt(v) + epsilon)

    return update_visible_rows


def update_visible(
    parameters: wp.array,
    gradients: wp.array,
    exp_avgs: wp.array,
    exp_avg_sqs: wp.array,
    visible: wp.array,
    rate: float,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Updates the visible rows of a parameter in place.

    Args:
        parameters: [N · length].
        gradients: [N · length].
        exp_avgs: [N · length], first moments.
        exp_avg_sqs: [N · length], second moments.
        visible: bool [N].
    """
    count = parameters.shape[0]
    scalars = [count // max(visible.shape[0], 1), rate, 1.0 - betas[0], 1.0 - betas[1], epsilon]
    arrays = [visible, gradients, parameters, exp_avgs, exp_avg_sqs]
    launch(selective_adam_kernel(parameters.dtype), count, [*scalars, *arrays], parameters.device)
