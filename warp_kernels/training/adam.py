"""Adam's update of many parameters in one pass over memory.

torch's fused update deals 65,536 numbers to a block, too few blocks to fill a large GPU with one scene's parameters;
here every four numbers are a thread. Formulas, defaults and order of operations: Kingma & Ba 2015, as
``torch.optim.Adam``; with decay Loshchilov & Hutter 2019, as ``torch.optim.AdamW``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import (
    BLOCK,
    QUAD,
    Addresses,
    Counts,
    addresses,
    counts,
    launches,
    load_quad,
    share_of,
    store_quad,
)


@wp.kernel(name="adam_coefficients", enable_backward=False, module="unique")
def adam_coefficients_kernel(
    beta1: wp.float64,
    beta2: wp.float64,
    decay: wp.float64,
    rates: Addresses,
    blocked: wp.array(dtype=wp.float32),  # [1]
    # inputs and outputs
    steps: Addresses,
    # outputs
    coefficients: wp.array(dtype=wp.vec3),  # [tensors]
):
    """Counts the step, and what a parameter's numbers share: rate / (1 - β1^t), sqrt(1 - β2^t) and 1 - rate · decay;
    each a thread."""
    if blocked[0] == 0.0:
        place = wp.tid()
        step = load_quad(steps[place], 0, 1)
        rate = load_quad(rates[place], 0, 1)
        step[0] = step[0] + 1.0
        store_quad(steps[place], 0, 1, step)
        t = wp.float64(step[0])
        one = wp.float64(1.0)
        step_size = wp.float64(rate[0]) / (one - wp.pow(beta1, t))
        root = wp.sqrt(one - wp.pow(beta2, t))
        kept = one - wp.float64(rate[0]) * decay
        coefficients[place] = wp.vec3(wp.float32(step_size), wp.float32(root), wp.float32(kept))


@wp.kernel(name="adam_update", enable_backward=False, module="unique")
def adam_update_kernel(
    ends: Counts,
    sizes: Counts,
    share1: wp.float32,
    beta2: wp.float32,
    share2: wp.float32,
    epsilon: wp.float32,
    blocked: wp.array(dtype=wp.float32),  # [1]
    coefficients: wp.array(dtype=wp.vec3),  # [tensors]
    gradients: Addresses,
    # inputs and outputs
    parameters: Addresses,
    exp_avgs: Addresses,
    exp_avg_sqs: Addresses,
):
    """Moments and parameters of four numbers; the gradient's shares 1 - β come from the host, where they are exact."""
    if blocked[0] != 0.0:
        return
    place, first = share_of(ends, wp.tid())
    size = int(sizes[place])
    if first >= size:
        return
    g = load_quad(gradients[place], first, size)
    m = load_quad(exp_avgs[place], first, size)
    v = load_quad(exp_avg_sqs[place], first, size)
    p = load_quad(parameters[place], first, size)
    c = coefficients[place]
    for k in range(wp.static(QUAD)):
        m[k] = m[k] + share1 * (g[k] - m[k])
        v[k] = beta2 * v[k] + share2 * g[k] * g[k]
        p[k] = c[2] * p[k] - c[0] * m[k] / (wp.sqrt(v[k]) / c[1] + epsilon)
    store_quad(exp_avgs[place], first, size, m)
    store_quad(exp_avg_sqs[place], first, size, v)
    store_quad(parameters[place], first, size, p)


@dataclass(frozen=True)
class AdamArrays:
    """One parameter and what Adam keeps of it, float32 without gaps.

    Attributes:
        parameter: [n].
        gradient: [n].
        exp_avg: [n], first moment.
        exp_avg_sq: [n], second moment.
        step: [1], updates done.
        rate: [1], learning rate.
    """

    parameter: wp.array
    gradient: wp.array
    exp_avg: wp.array
    exp_avg_sq: wp.array
    step: wp.array
    rate: wp.array


def adam_update(
    parameters: Sequence[AdamArrays],
    blocked: wp.array,
    betas: tuple[float, float],
    epsilon: float,
    decay: float = 0.0,
) -> None:
    """Updates parameters in place, all in the same two launches up to PLACES of them.

    Args:
        parameters: none of them empty.
        blocked: float32 [1]; not 0: leave everything as it is.
        decay: of the parameters; each loses rate · decay of itself.
    """
    for of_launch, ends in launches([len(p.parameter) for p in parameters]):
        some = parameters[of_launch]
        device = some[0].parameter.device
        coefficients = empty(len(some), wp.vec3, device)
        steps, rates = addresses([p.step for p in some]), addresses([p.rate for p in some])
        launch_again(adam_coefficients_kernel, len(some), [*betas, decay, rates, blocked, steps, coefficients], device)
        sizes = counts([len(p.parameter) for p in some])
        inputs = [counts(ends), sizes, 1.0 - betas[0], betas[1], 1.0 - betas[1], epsilon, blocked, coefficients]
        inputs += [addresses([p.gradient for p in some]), addresses([p.parameter for p in some])]
        inputs += [addresses([p.exp_avg for p in some]), addresses([p.exp_avg_sq for p in some])]
        launch_again(adam_update_kernel, ends[-1], inputs, device, BLOCK)
