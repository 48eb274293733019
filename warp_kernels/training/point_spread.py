"""Images as a camera blurs them: a Gaussian point spread along one axis, and its adjoint.

Weights beyond the image's border are left out and the others divided by their sum, so that an even image stays even.
With w_k of pixels k apart, x the image along the axis and the sums over pixels that exist,

    y_i = Σ_k w_k x_{i+k} / D_i,     D_i = Σ_k w_k,     dy_i/dσ = (Σ_k w'_k x_{i+k} - y_i Σ_k w'_k) / D_i.

Tables of weights have four rows, for k from 0 to the radius R: w_k, Σ_{j≤k} w_j, w'_k = dw_k/dσ and Σ_{j≤k} w'_j.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def point_spread_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread per number of the image.

    Returns:
        ``(spread, spread_adjoint)``.
    """

    @wp.func
    def total(
        table: wp.array2d(dtype=dtype),  # [4, R + 1]
        row: int,
        place: int,
        length: int,
    ):
        # Σ_k over both sides, of pixels that exist; the row has sums of one side, with the middle
        radius = table.shape[1] - 1
        before, behind = wp.min(radius, place), wp.min(radius, length - 1 - place)
        return table[row, before] + table[row, behind] - table[row - 1, 0]

    @wp.kernel(name=f"point_spread_{dtype.__name__}", enable_backward=False, module="unique")
    def spread_kernel(
        first: int,
        image: wp.array(dtype=dtype),  # [H * W * C]
        table: wp.array2d(dtype=dtype),  # [4, R + 1]
        stride: int,
        length: int,
        # outputs
        blurred: wp.array(dtype=dtype),  # [H * W * C]
    ):
        i = wp.tid() + first
        place = (i // stride) % length
        value = table[0, 0] * image[i]
        for k in range(1, table.shape[1]):
            if place >= k:
                value += table[0, k] * image[i - k * stride]
            if place + k < length:
                value += table[0, k] * image[i + k * stride]
        blurred[i] = value / total(table, 1, place, length)

    @wp.kernel(name=f"point_spread_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def spread_adjoint_kernel(
        first: int,
        image: wp.array(dtype=dtype),  # [H * W * C]
        blurred: wp.array(dtype=dtype),  # [H * W * C]
        table: wp.array2d(dtype=dtype),  # [4, R + 1]
        stride: int,
        length: int,
        v_blurred: wp.array(dtype=dtype),  # [H * W * C]
        # outputs
        v_image: wp.array(dtype=dtype),  # [H * W * C]
        v_sigmas: wp.array(dtype=dtype),  # [H * W * C], each number's share of the deviation's gradient
    ):
        i = wp.tid() + first
        place = (i // stride) % length
        here = total(table, 1, place, length)
        v = table[0, 0] * v_blurred[i] / here
        slope = table[2, 0] * image[i]
        for k in range(1, table.shape[1]):
            if place >= k:
                v += table[0, k] * v_blurred[i - k * stride] / total(table, 1, place - k, length)
                slope += table[2, k] * image[i - k * stride]
            if place + k < length:
                v += table[0, k] * v_blurred[i + k * stride] / total(table, 1, place + k, length)
                slope += table[2, k] * image[i + k * stride]
        v_image[i] = v
        v_sigmas[i] = v_blurred[i] * (slope - blurred[i] * total(table, 3, place, length)) / here

    return spread_kernel, spread_adjoint_kernel
