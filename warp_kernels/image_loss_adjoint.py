"""The adjoint of the image losses: blurs the derivatives by the moments back, along columns and then along rows.

The adjoint of a reflection at the border adds what the mirror images receive.
"""

import functools

import warp as wp

from warp_kernels.image_loss import RADIUS, REACH, STRIP, pixel_functions, window


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
    pixel, of_term = pixel_functions(dtype)
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)

    @wp.func
    def image_center(i: int, image: int, n: int):
        """Where input i and its two mirror images lie; far outside for a mirror image that no output sees."""
        center = i
        if image == 1:
            center = wp.where(i > 0, -i, -n)
        if image == 2:
            center = wp.where(i < n - 1, 2 * (n - 1) - i, 3 * n)
        return center

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
            for r in range(STRIP):
                image = int(0)
                while image < 3:
                    center = image_center(y + r, image, height)
                    for k in range(2 * RADIUS + 1):
                        at = center + k - RADIUS
                        if at >= 0 and at < height:
                            total[r] += taps[k] * derivatives[plane, at, x]
                    image += 1
        for r in range(STRIP):
            if y + r < height:
                blurred[plane, y + r, x] = total[r]

    @wp.kernel(name=f"image_loss_finish_rows_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
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
        index = wp.tid() + first
        x = (index % strips) * STRIP
        y = (index // strips) % height
        c = index // (strips * height)
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
            for r in range(STRIP):
                image = int(0)
                while image < 3:
                    center = image_center(x + r, image, width)
                    for k in range(2 * RADIUS + 1):
                        at = center + k - RADIUS
                        if at >= 0 and at < width:
                            by_x[r] += taps[k] * blurred[3 * c, y, at]
                            by_xx[r] += taps[k] * blurred[3 * c + 1, y, at]
                            by_xy[r] += taps[k] * blurred[3 * c + 2, y, at]
                    image += 1
        noise = of_term(noise0, noise1, noise2, noise3, e0, e1, e2, c)
        scale = of_term(
            share0 * v_losses[0], share1 * v_losses[1], share2 * v_losses[2], share3 * v_losses[3], e0, e1, e2, c
        )
        for r in range(STRIP):
            if x + r < width:
                a = pixel(x0, x1, x2, x3, e0, e1, e2, y, x + r, c)
                b = pixel(y0, y1, y2, y3, e0, e1, e2, y, x + r, c)
                slope = sign(a - b)
                if noise > zero:
                    slope = (a - b) / wp.sqrt((a - b) * (a - b) + noise * noise)
                v = scale * (by_x[r] + two * a * by_xx[r] + b * by_xy[r] + (one - ssim_share) * slope)
                if c >= smooth_from and c < smooth_to:
                    turns = dtype(0.0)
                    if x + r > 0:
                        turns += sign(a - pixel(x0, x1, x2, x3, e0, e1, e2, y, x + r - 1, c))
                    if x + r + 1 < width:
                        turns += sign(a - pixel(x0, x1, x2, x3, e0, e1, e2, y, x + r + 1, c))
                    if y > 0:
                        turns += sign(a - pixel(x0, x1, x2, x3, e0, e1, e2, y - 1, x + r, c))
                    if y + 1 < height:
                        turns += sign(a - pixel(x0, x1, x2, x3, e0, e1, e2, y + 1, x + r, c))
                    v += smooth_share * v_losses[4] * turns
                if c < e0:
                    v0[y, x + r, c] = v
                elif c < e1:
                    v1[y, x + r, c - e0] = v
                elif c < e2:
                    v2[y, x + r, c - e1] = v
                else:
                    v3[y, x + r, c - e2] = v

    return blur_columns_adjoint_kernel, finish_rows_adjoint_kernel
