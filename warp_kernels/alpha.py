"""Alpha of a projected Gaussian at a pixel, and bounds on where it is drawn; see blending for the formulas."""

import functools

import warp as wp

from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN
from warp_kernels.lanes import lane_functions


@functools.cache
def alpha_functions(dtype: type):
    """The response of a Gaussian at a pixel and its bounds; the forward pass and the adjoint share them.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(whiten, alpha, reaches_block, row_range)``, Warp functions.
    """
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    zero, half, one = dtype(0.0), dtype(0.5), dtype(1.0)
    alpha_min, alpha_max = dtype(ALPHA_MIN), dtype(ALPHA_MAX)
    exp_negative, _, _ = lane_functions(dtype)
    rounding = dtype(1.0e-5)
    tolerance = dtype(4.0e-7)

    @wp.func
    def whiten(root: vec3, dx: dtype, dy: dtype):
        """z = U d: an offset from the mean in the Gaussian's standard deviations; -σ = -½ |z|²."""
        return root[0] * (dx + root[1] * dy), root[2] * dy

    @wp.func
    def alpha(opacity: dtype, visibility: dtype):
        """α, zero where the Gaussian is not drawn."""
        a = wp.min(alpha_max, opacity * visibility)
        return wp.where(a < alpha_min, zero, a)

    @wp.func
    def edge_exponent(root: vec3, dx: dtype, dy: dtype):
        """σ less a bound on its rounding error, so that culling never drops what the blend would draw."""
        sheared = root[1] * dy
        error = tolerance * (wp.abs(dx) + wp.abs(sheared))
        s = root[0] * wp.max(wp.abs(dx + sheared) - error, zero)
        t = root[2] * dy
        return half * (s * s + t * t) * (one - tolerance) - rounding

    @wp.func
    def reaches_block(mean: vec2, root: vec3, opacity: dtype, x0: dtype, y0: dtype, x1: dtype, y1: dtype):
        """Whether α reaches ALPHA_MIN anywhere in the rectangle of pixel centres [x0, x1] x [y0, y1]."""
        left, right = mean[0] - x1, mean[0] - x0
        top, bottom = mean[1] - y1, mean[1] - y0
        smallest = dtype(1.0e30)
        inside_x = left <= zero and right >= zero
        inside_y = top <= zero and bottom >= zero
        if inside_x and inside_y:
            smallest = zero
        else:
            # The minimum over the rectangle lies on the edge that faces the mean, at its best point along that edge.
            if not inside_x:
                dx = wp.where(right < zero, right, left)
                uk = root[0] * root[1]
                tilt = uk * root[0] / (uk * uk + root[2] * root[2])
                smallest = edge_exponent(root, dx, wp.clamp(-tilt * dx, top, bottom))
            if not inside_y:
                dy = wp.where(bottom < zero, bottom, top)
                smallest = wp.min(smallest, edge_exponent(root, wp.clamp(-root[1] * dy, left, right), dy))
        return opacity * exp_negative(-wp.max(smallest, zero)) >= alpha_min * (one - rounding)

    @wp.func
    def row_range(mean: vec2, extent: vec2, y0: dtype, rows: int):
        """Rows [first, end) of a lane, whose first row of pixel centres is y0, that the ellipse reaches."""
        spare = extent[1] + dtype(1.0e-3) + dtype(1.0e-6) * (wp.abs(mean[1]) + extent[1])
        first = int(wp.ceil(wp.clamp(mean[1] - spare - y0, zero, dtype(rows))))
        end = int(wp.floor(wp.clamp(mean[1] + spare - y0, dtype(-1.0), dtype(rows - 1)))) + 1
        return first, end

    return whiten, alpha, reaches_block, row_range
