"""Image losses (1 - λ) |x - y| + λ (1 - SSIM) of up to TERMS pairs of images, in the same pass.

One pair has too few tiles for a large GPU, so the channels of all pairs are numbered through and share the pass.

SSIM's window is separable: a tile's x, y, x² + y² and xy are blurred along rows and then along columns (image_tiles),
which gives the moments of a pixel, and those its losses and their derivatives by the three moments that depend on x.
To |x - y| there may be added k (x - y)². By the way the pass sums the squared error of the clamped image, and where it
is wanted |∂x| + |∂y|. Borders are reflected (kornia, torchmetrics). The adjoint is in image_loss_adjoint.py.
"""

import warp as wp

from warp_kernels.image_loss.image_tiles import (
    PITCH,
    RADIUS,
    THREADS,
    WIDTH,
    blur_columns,
    blur_rows,
    buffers,
    fill,
    tile_height,
)
from warp_kernels.machinery.lanes import scalar_name
from warp_kernels.machinery.loading import made_once

TERMS = 4
"""Pairs of images that share the pass."""

OPTIONS = {"enable_backward": False, "module": "unique", "grid_stride": False, "launch_bounds": THREADS}
"""Of kernels with a block of threads a tile."""


@made_once
def plane_functions(dtype: type):
    """Access to the channels of all pairs, as they are numbered through.

    Returns:
        ``(plane, of_term)``. A thread looks a channel up once (``plane``: its address, and the steps to the next row
        and column): to choose among four images at every access would take all registers. Pair t has the channels from
        e(t - 1) up to et, without an end for the last; an image of a place that is not used is not read.
    """
    scalar = scalar_name(dtype)
    image_type = wp.array3d(dtype=dtype)

    @wp.func_native("return (wp::uint64)((char*)image.data + (long long)c * image.strides[2]);")
    def address(image: image_type, c: int) -> wp.uint64: ...

    @wp.func_native(f"return (int)(image.strides[axis] / (long long)sizeof({scalar}));")
    def step(image: image_type, axis: int) -> int: ...

    @wp.func
    def plane(
        i0: image_type,  # [H, W, channels of the pair]
        i1: image_type,  # [H, W, channels of the pair]
        i2: image_type,  # [H, W, channels of the pair]
        i3: image_type,  # [H, W, channels of the pair]
        e0: int,
        e1: int,
        e2: int,
        c: int,
    ):
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

    return plane, of_term


START = """
    const S_ C1 = (S_)C1_, C2 = (S_)C2_;
    S_ loss = 0, errors = 0, variation = 0;
    // index i mirrored into [0, n), the border itself not repeated
    const auto reflected = [](int i, int n) {
        int j = i < 0 ? -i : i;
        if (j >= n) j = 2 * (n - 1) - j;
        return j < 0 ? 0 : j;  // beyond the margins of the image's last tiles, where nobody looks
    };
"""

LOAD = """
        const int my = reflected(gy, height), mx = reflected(gx, width);
        held[0][at] = fetch((const S_*)of_x, my * x_row + mx * x_column);
        held[1][at] = fetch((const S_*)of_y, my * y_row + mx * y_column);
"""

SQUARES = "held[0][at] * held[0][at] + held[1][at] * held[1][at]"
BLURRED = f"{{held[0][at], held[1][at], {SQUARES}, held[0][at] * held[1][at]}}"

FINISH = """
                const S_ sx = t[0][r], sy = t[1][r], product = sx * sy, squares = sx * sx + sy * sy;
                const S_ A = 2 * product + C1, B = 2 * (t[3][r] - product) + C2;
                const S_ C = squares + C1, D = t[2][r] - squares + C2;
                const S_ inverse = 1 / (C * D + (S_)EPSILON_), ssim = A * B * inverse;
                const int at = (first + r + RADIUS_) * PITCH_ + column + RADIUS_;
                const S_ a = held[0][at], b = held[1][at];
                const S_ difference = wp::abs(a - b) + squared * (a - b) * (a - b);
                loss += (1 - ssim_share) * difference + ssim_share * (1 - ssim);
                const S_ error = wp::min(wp::max(a, (S_)0), (S_)1) - b;
                errors += error * error;
                if (smoothed) {
                    if (gy + 1 < height) variation += wp::abs(held[0][at + PITCH_] - a);
                    if (gx + 1 < width) variation += wp::abs(held[0][at + 1] - a);
                }
                if (derivatives.shape[0] > 0) {
                    // of -λ SSIM by the blurred x, x² and xy
                    const S_ by_x = 2 * inverse * (sy * (B - A) - ssim * sx * (D - C));
                    const int plane = height * width;
                    S_* out = derivatives.data + 3LL * c * plane + gy * width + gx;
                    out[0] = -ssim_share * by_x;
                    out[plane] = ssim_share * ssim * C * inverse;
                    out[2 * plane] = -ssim_share * 2 * A * inverse;
                }
"""

SUM = """
    const int channels = sums.shape[0] / 3, tiles = sums.shape[1];
#if defined(__CUDA_ARCH__)
    __shared__ S_ partial[3][THREADS_ / 32];
    #pragma unroll
    for (int distance = 16; distance > 0; distance /= 2) {
        loss += __shfl_down_sync(0xffffffffu, loss, distance);
        errors += __shfl_down_sync(0xffffffffu, errors, distance);
        variation += __shfl_down_sync(0xffffffffu, variation, distance);
    }
    if (thread % 32 == 0) {
        partial[0][thread / 32] = loss;
        partial[1][thread / 32] = errors;
        partial[2][thread / 32] = variation;
    }
    __syncthreads();
    if (thread < 3) {
        S_ total = 0;
        for (int warp = 0; warp < THREADS_ / 32; ++warp) total += partial[thread][warp];
        sums.data[(thread * channels + c) * tiles + tile] = total;
    }
#else
    sums.data[c * tiles + tile] = loss;
    sums.data[(channels + c) * tiles + tile] = errors;
    sums.data[(2 * channels + c) * tiles + tile] = variation;
#endif
"""


def scalar_source(source: str, dtype: type, **numbers: float) -> str:
    """Source for one scalar type.

    Args:
        source: C++ in which ``S_`` stands for the type, and names in capitals with ``_`` at the end for numbers.
        numbers: the numbers by name, without that end.
    """
    for name, value in numbers.items():
        source = source.replace(f"{name}_", repr(value))
    return source.replace("S_", "float" if dtype is wp.float32 else "double")


@made_once
def image_loss_kernels(dtype: type, sigma: float, c1: float, c2: float, epsilon: float):
    """The kernels of one window.

    Args:
        sigma: standard deviation of the window [px].

    Returns:
        ``(tiles, totals)``. Images x0 to x3 are compared with y0 to y3. The first has a block of threads a tile of a
        channel.
    """
    plane, of_term = plane_functions(dtype)
    height_of_tile = tile_height(dtype)
    parts = (
        START,
        buffers(2, 4, sigma, dtype),
        fill(dtype, LOAD),
        blur_rows(dtype, 4, BLURRED),
        blur_columns(dtype, 4, FINISH),
        SUM,
    )
    numbers = {"C1": c1, "C2": c2, "EPSILON": epsilon, "RADIUS": RADIUS, "PITCH": PITCH, "THREADS": THREADS}

    @wp.func_native(scalar_source("".join(parts), dtype, **numbers))
    def tile_losses(
        thread: int,
        tile: int,
        c: int,
        x0: int,
        y0: int,
        height: int,
        width: int,
        of_x: wp.uint64,
        x_row: int,
        x_column: int,
        of_y: wp.uint64,
        y_row: int,
        y_column: int,
        ssim_share: dtype,
        squared: dtype,
        smoothed: bool,
        sums: wp.array2d(dtype=dtype),
        derivatives: wp.array3d(dtype=dtype),
    ): ...

    @wp.kernel(name=f"image_loss_tiles_{dtype.__name__}", **OPTIONS)
    def tiles_kernel(
        first: int,
        x0: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        x1: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        x2: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        x3: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        y0: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        y1: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        y2: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        y3: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        e0: int,
        e1: int,
        e2: int,
        ssim_share: dtype,
        squared0: dtype,
        squared1: dtype,
        squared2: dtype,
        squared3: dtype,
        smooth_from: int,
        smooth_to: int,
        # outputs
        sums: wp.array2d(dtype=dtype),  # [3 C, tiles]
        derivatives: wp.array3d(dtype=dtype),  # [3 C, H, W]; [0, 0, 0]: not wanted
    ):
        block, thread = wp.tid()
        height, width = x0.shape[0], x0.shape[1]
        channels = sums.shape[0] // 3
        c = (block + first) % channels
        tile = (block + first) // channels
        across = (width + WIDTH - 1) // WIDTH
        of_x, x_row, x_column = plane(x0, x1, x2, x3, e0, e1, e2, c)
        of_y, y_row, y_column = plane(y0, y1, y2, y3, e0, e1, e2, c)
        tile_losses(
            thread,
            tile,
            c,
            (tile % across) * WIDTH,
            (tile // across) * height_of_tile,
            height,
            width,
            of_x,
            x_row,
            x_column,
            of_y,
            y_row,
            y_column,
            ssim_share,
            of_term(squared0, squared1, squared2, squared3, e0, e1, e2, c),
            c >= smooth_from and c < smooth_to,
            sums,
            derivatives,
        )

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
        sums: wp.array(dtype=dtype),  # [3 C]
        # outputs
        losses: wp.array(dtype=dtype),  # [TERMS + 1]
        squared_errors: wp.array(dtype=dtype),  # [TERMS]
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

    return tiles_kernel, totals_kernel
