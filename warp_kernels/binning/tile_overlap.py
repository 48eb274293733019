"""The pixels and tiles that a projected Gaussian touches.

The overlap is exact for the ellipse of alpha >= ALPHA_MIN against the pixel centres of some rows: within their band of
dy, the ellipse spans dx = -k dy ± sqrt(2τ (1 - (dy / ey)²)) / u with the conic's root (u, k, v), τ = ln(α / ALPHA_MIN)
and half-height ey, so that nothing cancels for needles.
"""

import warp as wp

from warp_kernels.constants import ALPHA_MIN
from warp_kernels.machinery.lanes import on_cuda, scalar_name
from warp_kernels.machinery.loading import made_once

# The bounds are widened a little, because the blend evaluates alpha in its own rounding: relative on the exponent and
# on the share of the height at which a span is taken, and in pixels on the span. Pairs admitted in excess cost time,
# never correctness.
EXPONENT_MARGIN = 1.0e-5
SHARE_MARGIN = 5.0e-7
PIXEL_MARGIN = 1.0e-3

# On CUDA within 1 ulp, which the margins cover; the exact one branches.
SQUARE_ROOT_F32 = (
    on_cuda('float r; asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));', "const float r = ::sqrtf(x);")
    + "return r;"
)
SQUARE_ROOT_F64 = "return ::sqrt(x);"


def _whole(rounding: str, instruction: str, dtype: type) -> str:
    """Rounds to a whole number that an int32 holds, by a function of C++ or by one instruction of CUDA."""
    name, suffix = scalar_name(dtype), "f" if dtype is wp.float32 else ""
    limited = f"({name})(!(x > -1e9) ? -1e9 : x < 1e9 ? x : 1e9)"
    return on_cuda(f"return __{name}2int_{instruction}(x);", f"return (int)::{rounding}{suffix}({limited});")


@wp.func_native(on_cuda("return 31 - __clz(x);", "return 31 - __builtin_clz((unsigned)x);"))
def exponent_of(x: int) -> int:
    """The exponent of a power of two; shifting by it is a division."""


@made_once
def overlap_functions(dtype: type):
    """Rows and columns of pixels and tiles a Gaussian touches.

    Returns:
        ``(pixel_rows, tile_range, ellipse, pixel_span)``, Warp functions.
    """
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    zero, half, one, two = dtype(0.0), dtype(0.5), dtype(1.0), dtype(2.0)
    margin, relative, alpha_min = dtype(PIXEL_MARGIN), dtype(1.0e-6), dtype(ALPHA_MIN)
    exponent_margin, share_margin = dtype(EXPONENT_MARGIN), dtype(SHARE_MARGIN)

    @wp.func_native(SQUARE_ROOT_F32 if dtype is wp.float32 else SQUARE_ROOT_F64)
    def square_root(x: dtype) -> dtype: ...

    @wp.func_native(_whole("ceil", "ru", dtype))
    def up(x: dtype) -> int: ...

    @wp.func_native(_whole("floor", "rd", dtype))
    def down(x: dtype) -> int: ...

    @wp.func
    def pixel_range(center: dtype, low: dtype, high: dtype, size: int):
        """Pixels whose centre lies in center + [low, high], as a half-open range clipped to the image."""
        spare = margin + relative * (wp.abs(center) + wp.max(wp.abs(low), wp.abs(high)))
        first = wp.max(0, up(center + low - half - spare))
        last = wp.min(size - 1, down(center + high - half + spare))
        return first, last + 1

    @wp.func
    def pixel_rows(mean2d: vec2, extent: vec2, height: int):
        """Rows of pixels [first, end) within the Gaussian's height."""
        return pixel_range(mean2d[1], -extent[1], extent[1], height)

    @wp.func
    def tile_range(first: int, end: int, tile_size: int):
        """Tiles [first, end) with any of the pixels [first, end)."""
        if end <= first:
            return 0, 0
        shift = exponent_of(tile_size)
        return first >> shift, ((end - 1) >> shift) + 1

    @wp.func
    def ellipse(root: vec3, extent: vec2, opacity: dtype):
        """What ``pixel_span`` needs of a Gaussian: -k, dy at its right extreme, half its width at dy = 0, 1 / ey."""
        exponent = wp.log(opacity / alpha_min) * (one + exponent_margin) + exponent_margin
        uk = root[0] * root[1]
        tilt = uk * root[0] / (uk * uk + root[2] * root[2])  # b / c of the conic
        return vec4(-root[1], -tilt * extent[0], wp.sqrt(two * exponent) / root[0], (one - share_margin) / extent[1])

    @wp.func
    def pixel_span(mean2d: vec2, extent: vec2, shape: vec4, row: int, row_end: int, width: int):
        """Columns of pixels [first, end) that the ellipse touches within some of its ``pixel_rows``."""
        # The band of the rows' pixel centres, relative to the mean, cut to the ellipse's height.
        top = wp.max(dtype(row) + half - mean2d[1], -extent[1])
        bottom = wp.min(dtype(row_end) - half - mean2d[1], extent[1])
        if bottom < top:
            # Only the rounding of pixel_rows brought us here: the ellipse's tip, its whole width is a safe answer.
            top = wp.clamp(top, -extent[1], extent[1])
            bottom = top
        # dy at which the ellipse reaches its right and left extremes, cut to the band
        right_dy = wp.clamp(shape[1], top, bottom)
        left_dy = wp.clamp(-shape[1], top, bottom)
        right_share = right_dy * shape[3]
        left_share = left_dy * shape[3]
        right = shape[0] * right_dy + shape[2] * square_root(wp.max(zero, one - right_share * right_share))
        left = shape[0] * left_dy - shape[2] * square_root(wp.max(zero, one - left_share * left_share))
        return pixel_range(mean2d[0], wp.max(left, -extent[0]), wp.min(right, extent[0]), width)

    return pixel_rows, tile_range, ellipse, pixel_span
