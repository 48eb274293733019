"""What blending reads of a Gaussian whose ellipse in the image is known: the end of every projection.

The 2D covariance without its blur is xx, xy, yy with the determinant det; see projection for the rest of the notation.
"""

import warp as wp

from warp_kernels.constants import ALPHA_MIN, EXTENT_MAX, EXTENT_MIN, RADIUS_MAX
from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.packed_roots import packed_root_functions


@made_once
def footprint_functions(dtype: type):
    """Stores for one scalar type.

    Returns:
        ``(culled, footprint)``, Warp functions. The first stores what there is of a Gaussian that is not drawn; the
        second what there is of one that is, if it is. Of many Gaussians most are not, so that little is stored of them.
    """
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    store2, _, store4 = store_functions(dtype)
    pack, _, _ = packed_root_functions(dtype)
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)
    alpha_min, extent_min, extent_max = dtype(ALPHA_MIN), dtype(EXTENT_MIN), dtype(EXTENT_MAX)
    largest_radius = dtype(RADIUS_MAX)
    sharpest = dtype(1.0e30 if dtype is wp.float32 else 1.0e300)  # times pixels squared stays finite

    @wp.func
    def culled(
        index: int,
        compensations: wp.array(dtype=dtype),  # [images · N]; [0]: not wanted
        visible: wp.array(dtype=wp.bool),  # [images · N]
    ):
        visible[index] = False
        if compensations.shape[0] > 0:
            compensations[index] = zero  # opacities are multiplied with it

    @wp.func
    def footprint(
        index: int,
        gaussian: int,
        mean2d: vec2,
        remainder: vec2,
        depth: dtype,
        sharp_xx: dtype,
        xy: dtype,
        sharp_yy: dtype,
        det: dtype,
        opacities: wp.array(dtype=dtype),  # [scenes · N]
        thermal_opacities: wp.array(dtype=dtype),  # [scenes · N]
        width: int,
        height: int,
        eps2d: dtype,
        radius_clip: dtype,
        antialiased: bool,
        # outputs
        means2d: wp.array(dtype=vec2),  # [images · N]
        depths: wp.array(dtype=dtype),  # [images · N]
        packed_roots: wp.array(dtype=vec4),  # [images · N]
        compensations: wp.array(dtype=dtype),  # [images · N]; [0]: not wanted
        visible: wp.array(dtype=wp.bool),  # [images · N]
        extents: wp.array(dtype=vec2),  # [images · N]
    ):
        det_blurred = det + eps2d * (sharp_xx + sharp_yy) + eps2d * eps2d
        xx = sharp_xx + eps2d
        yy = sharp_yy + eps2d
        if not (det_blurred > zero and wp.isfinite(det_blurred) and wp.isfinite(mean2d)):
            return
        root = vec3(wp.sqrt(yy / det_blurred), -xy / yy, one / wp.sqrt(yy))
        # The conic's largest entries, and the slope
        if not (xx + yy) / det_blurred <= sharpest or not wp.abs(root[1]) <= sharpest or not root[0] > zero:
            return
        compensation = dtype(1.0)
        if antialiased:
            compensation = wp.sqrt(wp.max(det / det_blurred, zero))

        # Opacity-aware extent (StopThePop, arXiv 2402.00525, section B.2): beyond it alpha is below ALPHA_MIN.
        opacity = wp.max(opacities[gaussian], thermal_opacities[gaussian]) * compensation
        if not (wp.isfinite(opacities[gaussian] + thermal_opacities[gaussian]) and opacity >= alpha_min):
            return
        extent = wp.clamp(wp.sqrt(two * wp.log(opacity / alpha_min)), extent_min, extent_max)
        ex = extent * wp.sqrt(xx)
        ey = extent * wp.sqrt(yy)
        rx = wp.min(wp.ceil(ex), largest_radius)  # radii: see info.radii_of
        ry = wp.min(wp.ceil(ey), largest_radius)
        if rx <= radius_clip and ry <= radius_clip:
            return
        if mean2d[0] + rx <= zero or mean2d[0] - rx >= dtype(width):
            return
        if mean2d[1] + ry <= zero or mean2d[1] - ry >= dtype(height):
            return

        store2(means2d, index, mean2d)
        depths[index] = depth
        store4(packed_roots, index, vec4(root[0], root[1], root[2], pack(remainder)))
        if compensations.shape[0] > 0:
            compensations[index] = compensation
        visible[index] = True
        store2(extents, index, vec2(ex, ey))

    return culled, footprint
