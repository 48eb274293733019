"""Alpha of a projected Gaussian at a pixel, and the rows in which it is drawn; see blending for the formulas."""

import math
from typing import Any, NamedTuple

import warp as wp

from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN
from warp_kernels.machinery.lanes import lane_functions
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.packed_roots import packed_root_functions

UNIT = math.sqrt(2.0 * math.log(2.0))
"""Standard deviations in which offsets are measured while blending: exp(-σ) is then 2^-|z|², one instruction."""


class AlphaFunctions(NamedTuple):
    """Warp functions of the response of a Gaussian at a pixel; they say themselves what they do.

    Attributes:
        from_middle: a mean as seen from the middle of a block.
        in_units: the conic's root for offsets in units of ``UNIT``.
        whiten: z = U d.
        visibility: exp(-σ).
        alpha: α.
        row_range: rows that a Gaussian reaches.
    """

    from_middle: Any
    in_units: Any
    whiten: Any
    visibility: Any
    alpha: Any
    row_range: Any


@made_once
def alpha_functions(dtype: type) -> AlphaFunctions:
    """The response of a Gaussian at a pixel; the forward pass and the adjoint share it."""
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    _, unpack, _ = packed_root_functions(dtype)
    zero = dtype(0.0)
    alpha_min, alpha_max, per_unit = dtype(ALPHA_MIN), dtype(ALPHA_MAX), dtype(1.0 / UNIT)
    exp2_negative, _, _ = lane_functions(dtype)

    @wp.func
    def from_middle(mean: vec2, packed_root: vec4, middle: vec2):
        """A mean as seen from near by, where its remainder is not lost to rounding."""
        return (mean - middle) + unpack(packed_root[3])

    @wp.func
    def in_units(root: vec4):
        """The conic's root for offsets z = U d in units of ``UNIT`` standard deviations."""
        return vec3(per_unit * root[0], root[1], per_unit * root[2])

    @wp.func
    def whiten(root: vec3, dx: dtype, dy: dtype):
        """z = U d."""
        return root[0] * (dx + root[1] * dy), root[2] * dy

    @wp.func
    def visibility(zx: dtype, zy: dtype):
        """exp(-σ), z being in units of ``UNIT`` standard deviations."""
        return exp2_negative(-zx * zx - zy * zy)

    @wp.func
    def alpha(opacity: dtype, visibility: dtype):
        """α, zero where the Gaussian is not drawn."""
        a = wp.min(alpha_max, opacity * visibility)
        return wp.where(a < alpha_min, zero, a)

    @wp.func
    def row_range(mean: vec2, extent: vec2, y0: dtype, rows: int):
        """Rows [first, end) of a lane, whose first row of pixel centres is y0, that the ellipse reaches."""
        spare = extent[1] + dtype(1.0e-3) + dtype(1.0e-6) * (wp.abs(mean[1]) + extent[1])
        first = int(wp.ceil(wp.clamp(mean[1] - spare - y0, zero, dtype(rows))))
        end = int(wp.floor(wp.clamp(mean[1] + spare - y0, dtype(-1.0), dtype(rows - 1)))) + 1
        return first, end

    return AlphaFunctions(from_middle, in_units, whiten, visibility, alpha, row_range)
