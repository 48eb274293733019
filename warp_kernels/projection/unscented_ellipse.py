"""The ellipse that the unscented transform makes of a Gaussian's seven points in the image, and the adjoint of that.

The transform is 3DGUT's (Wu et al., arXiv 2412.12507) with gsplat's α = 0.1, β = 2 and κ = 0; see affine_cameras for
the slopes a_i and the bows h_i. Its covariance is a sum over seven columns,

    Σ' = Σ c cᵀ,   c = a_i, ½ δ h_i (i = 1, 2, 3) and √(β - α²) s,   s = ½ Σ h_i.

Slopes are kept as six numbers, first those to the right and then those down, and bows likewise.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once

ALPHA, BETA = 0.1, 2.0
"""gsplat's, and 3DGUT's."""

SPREAD = ALPHA * 3.0**0.5
"""δ: how far the points lie from the mean [standard deviations]."""

vec6d = wp.types.vector(6, wp.float64)


@wp.func
def bows_together(bow: vec6d):
    """s, by which the mean of the points is off the image of the mean."""
    half = wp.float64(0.5)
    return wp.vec2d(half * (bow[0] + bow[1] + bow[2]), half * (bow[3] + bow[4] + bow[5]))


@wp.func
def ellipse(slope: vec6d, bow: vec6d):
    """Σ' as xx, xy, yy and its determinant: a sum of terms that are not negative, which does not cancel."""
    zero, two = wp.float64(0.0), wp.float64(2.0)
    a0, a1 = wp.vec3d(slope[0], slope[1], slope[2]), wp.vec3d(slope[3], slope[4], slope[5])
    normal = wp.cross(a0, a1)
    xx, xy, yy, det = wp.dot(a0, a0), wp.dot(a0, a1), wp.dot(a1, a1), wp.dot(normal, normal)
    s = bows_together(bow)
    columns = int(4)  # in a variable: a loop, and no copies of it
    for i in range(columns):
        c = wp.static(wp.float64((BETA - ALPHA**2) ** 0.5)) * s
        if i < 3:
            c = wp.static(wp.float64(0.5 * SPREAD)) * wp.vec2d(bow[i], bow[3 + i])
        det += wp.max(c[0] * (c[0] * yy - two * c[1] * xy) + c[1] * c[1] * xx, zero)  # cᵀ adj(Σ') c
        xx += c[0] * c[0]
        xy += c[0] * c[1]
        yy += c[1] * c[1]
    return xx, xy, yy, det


@made_once
def ellipse_gradient_function(dtype: type):
    """From the gradient of an ellipse in the image to those of slopes and bows.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of what is given.

    Returns:
        A Warp function of slopes and bows, the root and the compensation, their gradients, and eps2d.
    """
    vec3 = wp.types.vector(3, dtype)
    half, one, two = (wp.float64(x) for x in (0.5, 1.0, 2.0))
    share_of_bow, share_of_shift = wp.float64(0.25 * SPREAD**2), wp.float64(0.5 * (BETA - ALPHA**2))

    @wp.func
    def column_gradient(c: wp.vec2d, root: wp.vec3d, w: wp.vec3d, det: wp.vec4d):
        """2 V c for a column c, V the gradient to Σ': Uᵀ W U, and ``det`` as (v_blur, v_det xx, v_det xy, v_det yy)."""
        b0, b1 = root[0] * (c[0] + root[1] * c[1]), root[2] * c[1]
        v0 = root[0] * (w[0] * b0 + w[1] * b1)
        v1 = root[1] * v0 + root[2] * (w[1] * b0 + w[2] * b1)
        return wp.vec2d(
            v0 + two * (det[0] * c[0] + det[3] * c[0] - det[2] * c[1]),
            v1 + two * (det[0] * c[1] + det[1] * c[1] - det[2] * c[0]),
        )

    @wp.func
    def ellipse_gradient(
        slope: vec6d, bow: vec6d, root: vec3, rho: dtype, v_root: vec3, v_compensation: dtype, eps2d: dtype
    ):
        U = wp.vec3d(root)
        w = wp.vec3d(-U[0] * wp.float64(v_root[0]), -U[2] / U[0] * wp.float64(v_root[1]), -U[2] * wp.float64(v_root[2]))
        of_det = wp.vec4d()
        if rho > dtype(0.0):  # 0 in the classic mode
            xx, xy, yy, det = ellipse(slope, bow)
            blur, squared = wp.float64(eps2d), wp.float64(rho) * wp.float64(rho)
            share = half * wp.float64(v_compensation) / (wp.float64(rho) * (det + blur * (xx + yy) + blur * blur))
            v_det = share * (one - squared)
            of_det = wp.vec4d(-share * squared * blur, v_det * xx, v_det * xy, v_det * yy)
        v_s = share_of_shift * column_gradient(bows_together(bow), U, w, of_det)
        v_slope, v_bow = vec6d(), vec6d()
        count = int(3)  # in a variable: a loop, and no copies of it
        for i in range(count):
            v_a = column_gradient(wp.vec2d(slope[i], slope[3 + i]), U, w, of_det)
            v_h = share_of_bow * column_gradient(wp.vec2d(bow[i], bow[3 + i]), U, w, of_det) + v_s
            v_slope[i] = v_a[0]
            v_slope[3 + i] = v_a[1]
            v_bow[i] = v_h[0]
            v_bow[3 + i] = v_h[1]
        return v_slope, v_bow

    return ellipse_gradient
