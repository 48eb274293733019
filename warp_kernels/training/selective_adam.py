"""Adam's update of the rows that were visible, without correction of bias: Taming 3DGS's, as gsplat has it."""

import warp as wp

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
