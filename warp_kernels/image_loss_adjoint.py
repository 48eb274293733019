"""The adjoint of the image losses: blurs the derivatives by the moments back, along columns and then along rows.

The adjoint of a reflection at the border adds what the mirror images receive: of input i those at -i and 2 (n - 1) - i,
of whose windows only the taps towards the image meet it.
"""

import functools

import warp as wp

from warp_kernels.image_loss import OPTIONS, RADIUS, REACH, STRIP, plane_functions, window


@functools.cache
def image_loss_adjoint_kernels(dtype: type, sigma: float):
    """The kernels of one window.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
        sigma: standard deviation of the window [px].

    Returns:
        ``(blur_columns_adjoint, finish_rows_adjoint)``. Images x0 to x3 are compared with y0 to y3.
    """
    vecS = wp.types.vector(STRIP, dtype)
    vecW = wp.types.vector(2 * RADIUS + 1, dtype)
    taps = wp.constant(vecW(*window(sigma)))
    plane, read, write, of_term, strip_of = plane_functions(dtype)
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)

    @wp.func
    def sign(difference: dtype):
        return wp.where(difference > zero, one, wp.where(difference < zero, -one, zero))

    @wp.kernel(name=f"image_loss_blur_columns_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def blur_columns_adjoint_kernel(
        first: int,
        derivatives: wp.array3d(dtype=dtype),
        # outputs
        blurred: wp.array3d(dtype=dtype),
    ):
        height, width = derivatives.shape[1], derivatives.shape[2]
        strips = (height + STRIP - 1) // STRIP
        index = wp.tid() + first
        x = index % width
        y = ((index // width) % strips) * STRIP
        plane = index // (width * strips)
        inside = y > RADIUS and y + STRIP + RADIUS < height
        total = vecS()
        if inside:
            for k in range(REACH):
                value = derivatives[plane, y + k - RADIUS, x]
                for r in range(STRIP):
                    if k - r >= 0 and k - r <= 2 * RADIUS:
                        total[r] += taps[k - r] * value
        else:
            for k in range(REACH):
                at = y + k - RADIUS
                if at >= 0 and at < height:
                    value = derivatives[plane, at, x]
                    for r in range(STRIP):
                        if k - r >= 0 and k - r <= 2 * RADIUS:
                            total[r] += taps[k - r] * value
            for r in range(STRIP):
                i = y + r
                for k in range(1, RADIUS + 1):
                    if i > 0 and k >= i:
                        total[r] += taps[RADIUS + k] * derivatives[plane, k - i, x]
                    if i < height - 1 and k >= height - 1 - i:
                        total[r] += taps[RADIUS + k] * derivatives[plane, 2 * (height - 1) - i - k, x]
        for r in range(STRIP):
            if y + r < height:
                blurred[plane, y + r, x] = total[r]

    @wp.kernel(name=f"image_loss_finish_rows_adjoint_{dtype.__name__}", **OPTIONS)
    def finish_rows_adjoint_kernel(
        first: int,
        x0: wp.array3d(dtype=dtype),
        x1: wp.array3d(dtype=dtype),
        x2: wp.array3d(dtype=dtype),
        x3: wp.array3d(dtype=dtype),
        y0: wp.array3d(dtype=dtype),
        y1: wp.array3d(dtype=dtype),
        y2: wp.array3d(dtype=dtype),
        y3: wp.array3d(dtype=dtype),
        e0: int,
        e1: int,
        e2: int,
        ssim_share: dtype,
        noise0: dtype,
        noise1: dtype,
        noise2: dtype,
        noise3: dtype,
        smooth_from: int,
        smooth_to: int,
        share0: dtype,
        share1: dtype,
        share2: dtype,
        share3: dtype,
        smooth_share: dtype,
        blurred: wp.array3d(dtype=dtype),
        v_losses: wp.array(dtype=dtype),
        # outputs
        v0: wp.array3d(dtype=dtype),
        v1: wp.array3d(dtype=dtype),
        v2: wp.array3d(dtype=dtype),
        v3: wp.array3d(dtype=dtype),
    ):
        height, width = x0.shape[0], x0.shape[1]
        strips = (width + STRIP - 1) // STRIP
        y, strip, c = strip_of(wp.tid() + first, strips, e0, e1, e2, blurred.shape[0] // 3)
        x = strip * STRIP
        of_x, x_row, x_column = plane(x0, x1, x2, x3, e0, e1, e2, c)
        of_y, y_row, y_column = plane(y0, y1, y2, y3, e0, e1, e2, c)
        of_v, v_row, v_column = plane(v0, v1, v2, v3, e0, e1, e2, c)
        inside = x > RADIUS and x + STRIP + RADIUS < width
        by_x = vecS()
        by_xx = vecS()
        by_xy = vecS()
        if inside:
            for k in range(REACH):
                at = x + k - RADIUS
                d0 = blurred[3 * c, y, at]
                d1 = blurred[3 * c + 1, y, at]
                d2 = blurred[3 * c + 2, y, at]
                for r in range(STRIP):
                    if k - r >= 0 and k - r <= 2 * RADIUS:
                        by_x[r] += taps[k - r] * d0
                        by_xx[r] += taps[k - r] * d1
                        by_xy[r] += taps[k - r] * d2
        else:
            for k in range(REACH):
                at = x + k - RADIUS
                if at >= 0 and at < width:
                    d0 = blurred[3 * c, y, at]
                    d1 = blurred[3 * c + 1, y, at]
                    d2 = blurred[3 * c + 2, y, at]
                    for r in range(STRIP):
                        if k - r >= 0 and k - r <= 2 * RADIUS:
                            by_x[r] += taps[k - r] * d0
                            by_xx[r] += taps[k - r] * d1
                            by_xy[r] += taps[k - r] * d2
            for r in range(STRIP):
                i = x + r
                for k in range(1, RADIUS + 1):
                    if i > 0 and k >= i:
                        by_x[r] += taps[RADIUS + k] * blurred[3 * c, y, k - i]
                        by_xx[r] += taps[RADIUS + k] * blurred[3 * c + 1, y, k - i]
                        by_xy[r] += taps[RADIUS + k] * blurred[3 * c + 2, y, k - i]
                    if i < width - 1 and k >= width - 1 - i:
                        mirrored = 2 * (width - 1) - i - k
                        by_x[r] += taps[RADIUS + k] * blurred[3 * c, y, mirrored]
                        by_xx[r] += taps[RADIUS + k] * blurred[3 * c + 1, y, mirrored]
                        by_xy[r] += taps[RADIUS + k] * blurred[3 * c + 2, y, mirrored]
        noise = of_term(noise0, noise1, noise2, noise3, e0, e1, e2, c)
        scale = of_term(
            share0 * v_losses[0], share1 * v_losses[1], share2 * v_losses[2], share3 * v_losses[3], e0, e1, e2, c
        )
        for r in range(STRIP):
            if x + r < width:
                at = y * x_row + (x + r) * x_column
                a = read(of_x, at)
                b = read(of_y, y * y_row + (x + r) * y_column)
                slope = sign(a - b)
                if noise > zero:
                    slope = (a - b) / wp.sqrt((a - b) * (a - b) + noise * noise)
                v = scale * (by_x[r] + two * a * by_xx[r] + b * by_xy[r] + (one - ssim_share) * slope)
                if c >= smooth_from and c < smooth_to:
                    turns = dtype(0.0)
                    if x + r > 0:
                        turns += sign(a - read(of_x, at - x_column))
                    if x + r + 1 < width:
                        turns += sign(a - read(of_x, at + x_column))
                    if y > 0:
                        turns += sign(a - read(of_x, at - x_row))
                    if y + 1 < height:
                        turns += sign(a - read(of_x, at + x_row))
                    v += smooth_share * v_losses[4] * turns
                write(of_v, y * v_row + (x + r) * v_column, v)

    return blur_columns_adjoint_kernel, finish_rows_adjoint_kernel
