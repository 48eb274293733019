"""Image losses (1 - λ) |x - y| + λ (1 - SSIM) of up to TERMS pairs of images, in the same two passes.

One pair has too few threads for a large GPU, so the channels of all pairs are numbered through and share every pass.

SSIM's window is separable: a pass along rows blurs x, y, x², y² and xy; a pass along columns finishes the five moments
and forms the losses and their derivatives by the three moments that depend on x. In place of |x - y| there may be
sqrt((x - y)² + ε²) - ε (Charbonnier et al. 1994). By the way the second pass sums the squared error of the clamped
image, and where it is wanted |∂x| + |∂y|. Borders are reflected (kornia, torchmetrics). Each thread makes ``STRIP``
neighbouring outputs, so that a value is read a few times, not 11. The adjoint is in image_loss_adjoint.py.
"""

import functools
import math

import warp as wp

from warp_kernels.lanes import scalar_name

TERMS = 4
"""Pairs of images that share the passes."""

RADIUS = 5
"""Taps on each side of the window's centre [px]: 11 in all. Wang et al. 2004, 3DGS."""

STRIP = 4
"""Outputs of a thread."""

OPTIONS = {"enable_backward": False, "module": "unique", "launch_bounds": (256, 2)}
"""Of kernels whose loops, unrolled, would otherwise take so many registers that few threads fit on a multiprocessor."""

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
def plane_functions(dtype: type):
    """Access to the channels of all pairs, as they are numbered through.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(plane, read, write, of_term, strip_of)``. A thread looks a channel up once (``plane``: its address, and the
        steps to the next row and column) and reads and writes through that: to choose among four images at every
        access would take all registers. Pair t has the channels from e(t - 1) up to et, without an end for the last;
        an image of a place that is not used is not read.
    """
    scalar = scalar_name(dtype)
    image_type = wp.array3d(dtype=dtype)

    @wp.func_native("return (wp::uint64)((char*)image.data + (long long)c * image.strides[2]);")
    def address(image: image_type, c: int) -> wp.uint64: ...

    @wp.func_native(f"return (int)(image.strides[axis] / (long long)sizeof({scalar}));")
    def step(image: image_type, axis: int) -> int: ...

    read_snippet = f"return (({scalar}*)plane)[at];"
    write_snippet = f"(({scalar}*)plane)[at] = value;"

    @wp.func_native(read_snippet)
    def read(plane: wp.uint64, at: int) -> dtype: ...

    @wp.func_native(write_snippet)
    def write(plane: wp.uint64, at: int, value: dtype): ...

    @wp.func
    def plane(i0: image_type, i1: image_type, i2: image_type, i3: image_type, e0: int, e1: int, e2: int, c: int):
        """Address of channel c, steps to the next row and to the next column."""
        at = wp.uint64(0)
        row = int(0)
        column = int(0)
        if c < e0:
            at, row, column = address(i0, c), step(i0, 0), step(i0, 1)
        elif c < e1:
            at, row, column = address(i1, c - e0), step(i1, 0), step(i1, 1)
        elif c < e2:
            at, row, column = address(i2, c - e1), step(i2, 0), step(i2, 1)
        else:
            at, row, column = address(i3, c - e2), step(i3, 0), step(i3, 1)
        return at, row, column

    @wp.func
    def of_term(v0: dtype, v1: dtype, v2: dtype, v3: dtype, e0: int, e1: int, e2: int, c: int):
        """The number that belongs to channel c's term."""
        return wp.where(c < e0, v0, wp.where(c < e1, v1, wp.where(c < e2, v2, v3)))

    @wp.func
    def strip_of(index: int, strips: int, e0: int, e1: int, e2: int, channels: int):
        """Row, strip in it and channel of a thread: neighbours share a pixel, whose channels lie together."""
        y = index // (strips * channels)
        rest = index % (strips * channels)
        begin = int(0)
        end = e0
        if rest >= strips * e2:
            begin = e2
            end = channels
        elif rest >= strips * e1:
            begin = e1
            end = e2
        elif rest >= strips * e0:
            begin = e0
            end = e1
        rest = rest - strips * begin
        return y, rest // (end - begin), begin + rest % (end - begin)

    return plane, read, write, of_term, strip_of


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
        ``(blur_rows, finish_columns, totals)``. Images x0 to x3 are compared with y0 to y3.
    """
    vecS = wp.types.vector(STRIP, dtype)
    vecW = wp.types.vector(2 * RADIUS + 1, dtype)
    taps = wp.constant(vecW(*window(sigma)))
    plane, read, _, of_term, strip_of = plane_functions(dtype)
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)
    C1, C2, eps = dtype(c1), dtype(c2), dtype(epsilon)

    @wp.func
    def reflected(i: int, n: int):
        """Index i mirrored into [0, n), the border itself not repeated."""
        j = wp.abs(i)
        if j >= n:
            j = 2 * (n - 1) - j
        return wp.clamp(j, 0, n - 1)

    @wp.kernel(name=f"image_loss_blur_rows_{dtype.__name__}", **OPTIONS)
    def blur_rows_kernel(
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
        # outputs
        moments: wp.array3d(dtype=dtype),
    ):
        width = x0.shape[1]
        strips = (width + STRIP - 1) // STRIP
        y, strip, c = strip_of(wp.tid() + first, strips, e0, e1, e2, moments.shape[0] // 5)
        x = strip * STRIP
        of_x, x_row, x_column = plane(x0, x1, x2, x3, e0, e1, e2, c)
        of_y, y_row, y_column = plane(y0, y1, y2, y3, e0, e1, e2, c)
        sx = vecS()
        sy = vecS()
        sxx = vecS()
        syy = vecS()
        sxy = vecS()
        for k in range(REACH):
            at = reflected(x + k - RADIUS, width)
            a = read(of_x, y * x_row + at * x_column)
            b = read(of_y, y * y_row + at * y_column)
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

    @wp.kernel(name=f"image_loss_finish_columns_{dtype.__name__}", **OPTIONS)
    def finish_columns_kernel(
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
        moments: wp.array3d(dtype=dtype),
        # outputs
        sums: wp.array3d(dtype=dtype),
        derivatives: wp.array3d(dtype=dtype),
    ):
        height, width = x0.shape[0], x0.shape[1]
        strips = (height + STRIP - 1) // STRIP
        index = wp.tid() + first
        x = index % width
        y = ((index // width) % strips) * STRIP
        c = index // (width * strips)
        of_x, x_row, x_column = plane(x0, x1, x2, x3, e0, e1, e2, c)
        of_y, y_row, y_column = plane(y0, y1, y2, y3, e0, e1, e2, c)
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
        channels = moments.shape[0] // 5
        noise = of_term(noise0, noise1, noise2, noise3, e0, e1, e2, c)
        loss = dtype(0.0)
        squares_sum = dtype(0.0)
        variation = dtype(0.0)
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
                at = (y + r) * x_row + x * x_column
                a = read(of_x, at)
                b = read(of_y, (y + r) * y_row + x * y_column)
                difference = wp.abs(a - b)
                if noise > zero:
                    difference = wp.sqrt(difference * difference + noise * noise) - noise
                loss += (one - ssim_share) * difference + ssim_share * (one - ssim)
                error = wp.clamp(a, zero, one) - b
                squares_sum += error * error
                if c >= smooth_from and c < smooth_to:
                    if y + r + 1 < height:
                        variation += wp.abs(read(of_x, at + x_row) - a)
                    if x + 1 < width:
                        variation += wp.abs(read(of_x, at + x_column) - a)
                if derivatives.shape[0] > 0:
                    # of -λ SSIM by the blurred x, x² and xy
                    by_x = two * inverse * (sy[r] * (B - A) - ssim * sx[r] * (D - C))
                    derivatives[3 * c, y + r, x] = -ssim_share * by_x
                    derivatives[3 * c + 1, y + r, x] = ssim_share * ssim * C * inverse
                    derivatives[3 * c + 2, y + r, x] = -ssim_share * two * A * inverse
        strip = y // STRIP
        sums[c, strip, x] = loss
        sums[channels + c, strip, x] = squares_sum
        sums[2 * channels + c, strip, x] = variation

    @wp.kernel(name=f"image_loss_totals_{dtype.__name__}", enable_backward=False, module="unique")
    def totals_kernel(
        channels: int,
        e0: int,
        e1: int,
        e2: int,
        share0: dtype,
        share1: dtype,
        share2: dtype,
        share3: dtype,
        smooth_share: dtype,
        num_pixels: int,
        sums: wp.array(dtype=dtype),
        # outputs
        losses: wp.array(dtype=dtype),
        squared_errors: wp.array(dtype=dtype),
    ):
        """One thread a term, and one for |∂x| + |∂y|."""
        term = wp.tid()
        start = wp.where(term == 0, 0, wp.where(term == 1, e0, wp.where(term == 2, e1, e2)))
        end = wp.where(term == 0, e0, wp.where(term == 1, e1, wp.where(term == 2, e2, channels)))
        if term == wp.static(TERMS):
            start = 0
            end = channels
        loss = dtype(0.0)
        errors = dtype(0.0)
        variation = dtype(0.0)
        for c in range(start, end):
            loss += sums[c]
            errors += sums[channels + c]
            variation += sums[2 * channels + c]
        if term == wp.static(TERMS):
            losses[term] = smooth_share * variation
        else:
            losses[term] = of_term(share0, share1, share2, share3, 1, 2, 3, term) * loss
            squared_errors[term] = errors / dtype(wp.max(end - start, 1) * num_pixels)

    return blur_rows_kernel, finish_columns_kernel, totals_kernel
