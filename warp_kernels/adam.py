"""Adam's update of one parameter in one pass over memory.

torch's fused update deals 65,536 numbers to a block, too few blocks to fill a large GPU with one scene's parameters;
here every number is a thread. Formulas, defaults and order of operations: Kingma & Ba 2015, as ``torch.optim.Adam``.
"""

import warp as wp

from warp_kernels.launching import launch


@wp.kernel(name="adam_coefficients", enable_backward=False, module="unique")
def adam_coefficients_kernel(
    beta1: wp.float64,
    beta2: wp.float64,
    rate: wp.array(dtype=wp.float32),
    blocked: wp.array(dtype=wp.float32),
    # inputs and outputs
    step: wp.array(dtype=wp.float32),
    # outputs
    coefficients: wp.array(dtype=wp.vec2),
):
    """Counts the step, and what all numbers of a parameter share: rate / (1 - β1^t) and sqrt(1 - β2^t); one thread."""
    if blocked[0] == 0.0:
        step[0] = step[0] + 1.0
        t = wp.float64(step[0])
        one = wp.float64(1.0)
        step_size = wp.float64(rate[0]) / (one - wp.pow(beta1, t))
        coefficients[0] = wp.vec2(wp.float32(step_size), wp.float32(wp.sqrt(one - wp.pow(beta2, t))))


@wp.kernel(name="adam_update", enable_backward=False, module="unique")
def adam_update_kernel(
    first: int,
    share1: wp.float32,
    beta2: wp.float32,
    share2: wp.float32,
    epsilon: wp.float32,
    blocked: wp.array(dtype=wp.float32),
    coefficients: wp.array(dtype=wp.vec2),
    gradient: wp.array(dtype=wp.float32),
    # inputs and outputs
    parameter: wp.array(dtype=wp.float32),
    exp_avg: wp.array(dtype=wp.float32),
    exp_avg_sq: wp.array(dtype=wp.float32),
):
    """Moments and parameter of one number; the gradient's shares 1 - β come from the host, where 1 - 0.999 is exact."""
    if blocked[0] != 0.0:
        return
    i = wp.tid() + first
    g = gradient[i]
    m = exp_avg[i] + share1 * (g - exp_avg[i])
    v = beta2 * exp_avg_sq[i] + share2 * g * g
    exp_avg[i] = m
    exp_avg_sq[i] = v
    c = coefficients[0]
    parameter[i] = parameter[i] - c[0] * m / (wp.sqrt(v) / c[1] + epsilon)


def adam_update(
    parameter: wp.array,
    gradient: wp.array,
    exp_avg: wp.array,
    exp_avg_sq: wp.array,
    step: wp.array,
    rate: wp.array,
    blocked: wp.array,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Updates one parameter in place.

    Args:
        parameter: float32 [n].
        gradient: float32 [n].
        exp_avg: float32 [n], first moment.
        exp_avg_sq: float32 [n], second moment.
        step: float32 [1], updates done.
        rate: float32 [1], learning rate.
        blocked: float32 [1]; not 0: leave everything as it is.
        betas: decay of the moments.
        epsilon: added to the denominator.
    """
    device = parameter.device
    coefficients = wp.empty(1, dtype=wp.vec2, device=device)
    inputs = [wp.float64(betas[0]), wp.float64(betas[1]), rate, blocked, step, coefficients]
    wp.launch(adam_coefficients_kernel, dim=1, inputs=inputs, device=device, record_tape=False)
    shared = [1.0 - betas[0], betas[1], 1.0 - betas[1], epsilon, blocked, coefficients]
    launch(adam_update_kernel, len(parameter), [*shared, gradient, parameter, exp_avg, exp_avg_sq], device)
