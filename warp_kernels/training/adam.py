"""Adam's update of many parameters in one pass over memory.

torch's fused update deals 65,536 numbers to a block, too few blocks to fill a large GPU with one scene's parameters;
here every four numbers are a thread. Formulas, defaults and order of operations: Kingma & Ba 2015, as
``torch.optim.Adam``; with decay Loshchilov & Hutter 2019, as ``torch.optim.AdamW``.
"""

import warp as wp

from warp_kernels.machinery.tensor_tables import (
    QUAD,
    Addresses,
    Counts,
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
