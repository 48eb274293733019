"""The image loss (1 - λ) |x - y| + λ (1 - SSIM) and its gradient, four passes over the images.

SSIM's window is separable: a pass along rows blurs x, y, x², y² and xy; a pass along columns finishes the five moments
and forms the loss of each pixel and the derivatives by the three moments that depend on x. The adjoint blurs those
three back, along columns and then along rows. Borders are reflected (kornia, torchmetrics); the adjoint of a reflection
adds what the mirror images receive. Each thread makes ``STRIP`` neighbouring outputs, so that a value is read a few
times, not 11.
"""

import functools
import math

import warp as wp

RADIUS = 5
"""Taps on each side of the window's centre [px]: 11 in all. Wang et al. 2004, 3DGS."""

STRIP = 4
"""Outputs of a thread."""

REACH = STRIP + 2 * RADIUS
"""Inputs a thread reads."""


def window(sigma: float) -> list[float]:
    """The Gaussian window, summing to 1.

    Args:
        sigma: standard deviation [px].

    Returns:
        2 RADIUS + 1 numbers.
    """
    taps = [math.exp(-(k**2) / (2.0 * sigma**2)) for k in range(-RADIUS, RADIUS + 1)]
    return [tap / sum(taps) for tap in taps]


@functools.cache
def image_loss_kernels(dtype: type, sigma: float, c1: float, c2: float, epsilon: float):
    """The kernels of one window.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
        sigma: standard deviation of the window [px].
        c1: SSIM's first constant.
        c2: SSIM's second constant.
        epsilon: added to SSIM's denominator.

    Returns:
        ``(blur_rows, finish_columns, blur_columns_adjoint, finish_rows_adjoint)``.
    """
    vecS = wp.types.vector(STRIP, dtype)
    vecW = wp.types.vector(2 * RADIUS + 1, dtype)
    taps = wp.constant(vecW(*window(sigma)))
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)
    C1, C2, eps = dtype(c1), dtype(c2), dtype(epsilon)

    @wp.func
    def reflected(i: int, n: int):
        """Index i mirrored into [0, n), the border itself not repeated."""
        j = wp.abs(i)
        if j >= n:
            j = 2 * (n - 1) - j
        return wp.clamp(j, 0, n - 1)

    @wp.func
    def image_center(i: int, image: int, n: int):
        """Where input i and its two mirror images lie; far outside for a mirror image that no output sees."""
        center = i
        if image == 1:
            center = wp.where(i > 0, -i, -n)
        if image == 2:
            center = wp.where(i < n - 1, 2 * (n - 1) - i, 3 * n)
        return center

    @wp.kernel(name=f"image_loss_blur_rows_{dtype.__name__}", enable_backward=False, module="unique")
    def blur_rows_kernel(
        first: int,
        render: wp.array3d(dtype=dtype),
        target: wp.array3d(dtype=dtype),
        # outputs
        moments: wp.array3d(dtype=dtype),
    ):
        height, width = render.shape[0], render.shape[1]
        strips = (width + STRIP - 1) // STRIP
        index = wp.tid() + first
        x = (index % strips) * STRIP
        y = (index // strips) % height
        c = index // (strips * height)
        sx = vecS()
        sy = vecS()
        sxx = vecS()
        syy = vecS()
        sxy = vecS()
        for k in range(REACH):
            at = reflected(x + k - RADIUS, width)
            a = render[y, at, c]
            b = target[y, at, c]
            for r in range(STRIP):
                if k - r >= 0 and k - r <= 2 * RADIUS:
                    w = taps[k - r]
                    sx[r] += w * a
                    sy[r] += w * b
                    sxx[r] += w * (a * a)
                    syy[r] += w * (b * b)
                    sxy[r] += w * (a * b)
        for r in range(STRIP):
            if x + r < width:
                moments[5 * c, y, x + r] = sx[r]
                moments[5 * c + 1, y, x + r] = sy[r]
                moments[5 * c + 2, y, x + r] = sxx[r]
                moments[5 * c + 3, y, x + r] = syy[r]
                moments[5 * c + 4, y, x + r] = sxy[r]

    @wp.kernel(name=f"image_loss_finish_columns_{dtype.__name__}", enable_backward=False, module="unique")
    def finish_columns_kernel(
        first: int,
        ssim_share: dtype,
        render: wp.array3d(dtype=dtype),
        target: wp.array3d(dtype=dtype),
        moments: wp.array3d(dtype=dtype),
        # outputs
        losses: wp.array3d(dtype=dtype),
        derivatives: wp.array3d(dtype=dtype),
    ):
        height, width = render.shape[0], render.shape[1]
        strips = (height + STRIP - 1) // STRIP
        index = wp.tid() + first
        x = index % width
        y = ((index // width) % strips) * STRIP
        c = index // (width * strips)
        sx = vecS()
        sy = vecS()
        sxx = vecS()
        syy = vecS()
        sxy = vecS()
        for k in range(REACH):
            at = reflected(y + k - RADIUS, height)
            m0 = moments[5 * c, at, x]
            m1 = moments[5 * c + 1, at, x]
            m2 = moments[5 * c + 2, at, x]
            m3 = moments[5 * c + 3, at, x]
            m4 = moments[5 * c + 4, at, x]
            for r in range(STRIP):
                if k - r >= 0 and k - r <= 2 * RADIUS:
                    w = taps[k - r]
                    sx[r] += w * m0
                    sy[r] += w * m1
                    sxx[r] += w * m2
                    syy[r] += w * m3
                    sxy[r] += w * m4
        for r in range(STRIP):
            if y + r < height:
                product = sx[r] * sy[r]
                squares = sx[r] * sx[r] + sy[r] * sy[r]
                A = two * product + C1
                B = two * (sxy[r] - product) + C2
                C = squares + C1
                D = sxx[r] + syy[r] - squares + C2
                inverse = one / (C * D + eps)
                ssim = A * B * inverse
                difference = wp.abs(render[y + r, x, c] - target[y + r, x, c])
                losses[c, y + r, x] = (one - ssim_share) * difference + ssim_share * (one - ssim)
                if derivatives.shape[0] > 0:
                    # of -λ SSIM by the blurred x, x² and xy
                    by_x = two * inverse * (sy[r] * (B - A) - ssim * sx[r] * (D - C))
                    derivatives[3 * c, y + r, x] = -ssim_share * by_x
                    derivatives[3 * c + 1, y + r, x] = ssim_share * ssim * C * inverse
                    derivatives[3 * c + 2, y + r, x] = -ssim_share * two * A * inverse

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
        ssim_share: dtype,
        render: wp.array3d(dtype=dtype),
        target: wp.array3d(dtype=dtype),
        blurred: wp.array3d(dtype=dtype),
        v_mean: wp.array(dtype=dtype),
        # outputs
        v_render: wp.array3d(dtype=dtype),
    ):
        height, width = render.shape[0], render.shape[1]
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
        scale = v_mean[0] / dtype(height * width * render.shape[2])
        for r in range(STRIP):
            if x + r < width:
                a = render[y, x + r, c]
                b = target[y, x + r, c]
                sign = wp.where(a > b, one, wp.where(a < b, -one, zero))
                v = by_x[r] + two * a * by_xx[r] + b * by_xy[r]
                v_render[y, x + r, c] = scale * (v + (one - ssim_share) * sign)

    return blur_rows_kernel, finish_columns_kernel, blur_columns_adjoint_kernel, finish_rows_adjoint_kernel
