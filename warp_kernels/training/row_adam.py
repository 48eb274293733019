"""Adam's update of some rows of a parameter; the others and their moments stay as they are.

Parameter and moments may lie in the host's memory, pinned: the device then reads and writes these rows over the bus.
The values of the rows come beside their gradient, since whoever had a gradient for them has fetched them already.
"""

from dataclasses import dataclass

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import BLOCK, addresses
from warp_kernels.training.adam import adam_coefficients_kernel

THREADS = 2**30
"""Numbers that one launch updates, at most: threads have numbers of 32 bits."""


@wp.kernel(name="row_adam_update", enable_backward=False, module="unique")
def row_adam_kernel(
    first: wp.int64,
    used: int,
    share1: wp.float32,
    beta2: wp.float32,
    share2: wp.float32,
    epsilon: wp.float32,
    blocked: wp.array(dtype=wp.float32),  # [1]
    coefficients: wp.array(dtype=wp.vec2),  # [1]
    indices: wp.array(dtype=wp.int64),  # [n]
    values: wp.array2d(dtype=wp.float32),  # [n, used]
    gradients: wp.array2d(dtype=wp.float32),  # [n, used]
    # inputs and outputs
    exp_avg: wp.array2d(dtype=wp.float32),  # [N, K]
    exp_avg_sq: wp.array2d(dtype=wp.float32),  # [N, K]
    # outputs
    parameter: wp.array2d(dtype=wp.float32),  # [N, K]
):
    """Moments and parameter of one number; threads that follow each other share a row, which is read in one piece."""
    if blocked[0] != 0.0:
        return
    number = first + wp.int64(wp.tid())
    place = int(number / wp.int64(used))
    column = int(number - wp.int64(place) * wp.int64(used))
    row = int(indices[place])
    g = gradients[place, column]
    m = exp_avg[row, column]
    v = exp_avg_sq[row, column]
    m = m + share1 * (g - m)
    v = beta2 * v + share2 * g * g
    c = coefficients[0]
    exp_avg[row, column] = m
    exp_avg_sq[row, column] = v
    parameter[row, column] = values[place, column] - c[0] * m / (wp.sqrt(v) / c[1] + epsilon)


@dataclass(frozen=True)
class RowAdamArrays:
    """Some rows of one parameter and what Adam keeps of it, float32 without gaps.

    Attributes:
        indices: int64 [n], the rows, each once.
        values: [n, used], the first numbers of these rows as they are. The others have no gradient and no moments.
        gradient: [n, used].
        parameter: [N, K], K >= used.
        exp_avg: [N, K], first moment.
        exp_avg_sq: [N, K], second moment.
        step: [1], updates done.
        rate: [1], learning rate.
    """

    indices: wp.array
    values: wp.array
    gradient: wp.array
    parameter: wp.array
    exp_avg: wp.array
    exp_avg_sq: wp.array
    step: wp.array
    rate: wp.array


def row_adam_update(rows: RowAdamArrays, blocked: wp.array, betas: tuple[float, float], epsilon: float) -> None:
    """Updates rows in place, and counts the update, also one of no rows.

    Args:
        rows: of one parameter.
        blocked: float32 [1]; not 0: leave everything as it is.
        betas: decay of the moments.
        epsilon: added to the denominator.
    """
    device = rows.step.device
    coefficients = empty(1, wp.vec2, device)
    counted = [*betas, addresses([rows.rate]), blocked, addresses([rows.step]), coefficients]
    launch_again(adam_coefficients_kernel, 1, counted, device)
    number, used = rows.values.shape
    scalars = [used, 1.0 - betas[0], betas[1], 1.0 - betas[1], epsilon]
    arrays = [rows.indices, rows.values, rows.gradient, rows.exp_avg, rows.exp_avg_sq, rows.parameter]
    for first in range(0, number * used, THREADS):
        threads = min(THREADS, number * used - first)
        launch_again(row_adam_kernel, threads, [first, *scalars, blocked, coefficients, *arrays], device, BLOCK)
