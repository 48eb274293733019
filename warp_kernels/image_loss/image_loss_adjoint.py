"""The adjoint of the image losses: blurs the derivatives by the moments back, along rows and then along columns.

Both blurs are symmetric but for the borders, at which a derivative also counts for what its reflection met.
"""

import warp as wp

from warp_kernels.image_loss.image_loss import OPTIONS, plane_functions, scalar_source
from warp_kernels.image_loss.image_tiles import (
    BLURRED_PITCH,
    PITCH,
    RADIUS,
    WIDTH,
    blur_columns,
    blur_rows,
    buffers,
    fill,
    mirrored,
    tile_height,
)
from warp_kernels.machinery.loading import made_once

LOAD = """
        const bool inside = gy >= 0 && gy < height && gx >= 0 && gx < width;
        const int plane = height * width;
        const S_* from = derivatives.data + 3LL * c * plane;  // an image of 72 megapixels has more than 2^31 in all
        #pragma unroll
        for (int p = 0; p < 3; ++p) held[p][at] = inside ? fetch(from, gy * width + gx + p * plane) : (S_)0;
"""

HELD = "{held[0][at], held[1][at], held[2][at]}"
BLURRED = "{blurred[0][at], blurred[1][at], blurred[2][at]}"

FINISH = """
                const S_* x = (const S_*)of_x + gy * x_row + gx * x_column;
                const S_ a = fetch(x, 0), b = fetch((const S_*)of_y, gy * y_row + gx * y_column), difference = a - b;
                const auto sign = [](S_ value) { return (S_)(value > 0) - (S_)(value < 0); };
                const S_ slope = sign(difference) + 2 * squared * difference;
                S_ v = scale * (t[0][r] + 2 * a * t[1][r] + b * t[2][r] + (1 - ssim_share) * slope);
                if (smooth_scale != 0) {
                    S_ turns = 0;
                    if (gx > 0) turns += sign(a - fetch(x, -x_column));
                    if (gx + 1 < width) turns += sign(a - fetch(x, x_column));
                    if (gy > 0) turns += sign(a - fetch(x, -x_row));
                    if (gy + 1 < height) turns += sign(a - fetch(x, x_row));
                    v += smooth_scale * turns;
                }
                ((S_*)of_v)[gy * v_row + gx * v_column] = v;
"""


@made_once
def image_loss_adjoint_kernel(dtype: type, sigma: float) -> wp.Kernel:
    """The kernel of one window, a block of threads a tile of a channel.

    Args:
        sigma: standard deviation of the window [px].

    Returns:
        The Warp kernel. Images x0 to x3 are compared with y0 to y3.
    """
    plane, of_term = plane_functions(dtype)
    height_of_tile = tile_height(dtype)
    row = f"row * {PITCH} + j - x0 + {RADIUS}"
    column = f"(j - y0 + {RADIUS}) * {BLURRED_PITCH} + column"
    parts = (
        buffers(3, 3, sigma, dtype),
        fill(dtype, LOAD),
        blur_rows(dtype, 3, HELD, mirrored(3, "x0 + first", "width", HELD, row)),
        blur_columns(dtype, 3, FINISH, mirrored(3, "y0 + first", "height", BLURRED, column)),
    )

    @wp.func_native(scalar_source("".join(parts), dtype))
    def tile_adjoint(
        thread: int,
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
        of_v: wp.uint64,
        v_row: int,
        v_column: int,
        ssim_share: dtype,
        squared: dtype,
        scale: dtype,
        smooth_scale: dtype,
        derivatives: wp.array3d(dtype=dtype),
    ): ...

    @wp.kernel(name=f"image_loss_tiles_adjoint_{dtype.__name__}", **OPTIONS)
    def tiles_adjoint_kernel(
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
        share0: dtype,
        share1: dtype,
        share2: dtype,
        share3: dtype,
        smooth_share: dtype,
        derivatives: wp.array3d(dtype=dtype),  # [3 C, H, W]
        v_losses: wp.array(dtype=dtype),  # [TERMS + 1]
        # outputs
        v0: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        v1: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        v2: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
        v3: wp.array3d(dtype=dtype),  # [H, W, channels of the pair]
    ):
        block, thread = wp.tid()
        height, width = x0.shape[0], x0.shape[1]
        channels = derivatives.shape[0] // 3
        c = (block + first) % channels
        tile = (block + first) // channels
        across = (width + WIDTH - 1) // WIDTH
        of_x, x_row, x_column = plane(x0, x1, x2, x3, e0, e1, e2, c)
        of_y, y_row, y_column = plane(y0, y1, y2, y3, e0, e1, e2, c)
        of_v, v_row, v_column = plane(v0, v1, v2, v3, e0, e1, e2, c)
        scale = of_term(
            share0 * v_losses[0], share1 * v_losses[1], share2 * v_losses[2], share3 * v_losses[3], e0, e1, e2, c
        )
        smooth_scale = dtype(0.0)
        if c >= smooth_from and c < smooth_to:
            smooth_scale = smooth_share * v_losses[4]
        tile_adjoint(
            thread,
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
            of_v,
            v_row,
            v_column,
            ssim_share,
            of_term(squared0, squared1, squared2, squared3, e0, e1, e2, c),
            scale,
            smooth_scale,
            derivatives,
        )

    return tiles_adjoint_kernel
