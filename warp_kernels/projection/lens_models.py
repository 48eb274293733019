"""How lenses bend rays: from a point in camera axes to normalised image coordinates, with the Jacobian.

Sources of the formulas: OpenCV's documentation of calib3d, for the rational model with tangential and thin-prism terms
and for the fisheye model; gsplat's ``FThetaCameraDistortionParameters`` for NVIDIA's f-theta. All is computed in
float64: projections through a lens are subtracted from one another (see affine_cameras).

A lens has ``LENS_COEFFS`` numbers, zero where its model has fewer:

- pinhole: k1 to k6, p1, p2, s1 to s4. With x, y = X / Z, Y / Z, r² = x² + y² and
  c = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),
  x' = c x + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴ and y' = c y + p1 (r² + 2 y²) + 2 p2 x y + s3 r² + s4 r⁴.
- radial: k1 to k6 of a pinhole lens, whose other numbers are zero; that takes half the operations.
- ortho: none; x', y' = X, Y.
- fisheye: k1 to k4. At the angle θ to the axis, r' = θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹.
- ftheta: six coefficients of the distance from the principal point [px] as a polynomial of θ; six that are not used; c,
  d and e of the matrix [c, d; e, 1] that follows; the largest angle.
- ftheta_inverse: six coefficients of θ as a polynomial of the distance; six of the distance, where Newton's method
  begins; c, d, e and the largest angle as above.

A point is not seen where Z is not positive, or beyond the angle at which the image folds back (lens_limits.py).
"""

from typing import Literal

import warp as wp

from warp_kernels.machinery.loading import made_once

LensModel = Literal["pinhole", "radial", "ortho", "fisheye", "ftheta", "ftheta_inverse"]

RATIONAL = ("pinhole", "radial")
"""Models whose radial part is a fraction."""

MAPPED = ("ftheta", "ftheta_inverse")
"""Models with a matrix and a largest angle."""

LENS_COEFFS = 16
"""Numbers of a lens."""

NEWTON_STEPS = 12
"""Of the inverse of a polynomial; from the other polynomial of a calibration four are enough."""

lens_vector = wp.types.vector(LENS_COEFFS, wp.float64)
mat23d = wp.types.matrix((2, 3), wp.float64)


@made_once
def lens_functions(model: LensModel):
    """What a lens does to a point.

    Returns:
        ``(bend, coefficient_gradient, radial_slope)``, Warp functions in float64.
    """
    if model == "ortho":
        return _parallel()
    return _rational(centred=model == "radial") if model in RATIONAL else _angular(model)


def _parallel():
    zero, one = wp.float64(0.0), wp.float64(1.0)

    @wp.func
    def bend(p: wp.vec3d, k: lens_vector, limit: wp.float64):
        return True, wp.vec2d(p[0], p[1]), mat23d(one, zero, zero, zero, one, zero)

    @wp.func
    def coefficient_gradient(p: wp.vec3d, k: lens_vector, v: wp.vec2d):
        return lens_vector()

    @wp.func
    def radial_slope(angle: wp.float64, k: lens_vector):
        return one

    return bend, coefficient_gradient, radial_slope


def _rational(*, centred: bool):
    """``centred``: without tangential and thin-prism terms."""
    zero, one, two, three, six = (wp.float64(x) for x in (0.0, 1.0, 2.0, 3.0, 6.0))

    @wp.func
    def radial(square: wp.float64, k: lens_vector):
        """c at r², its derivative in r², and its denominator."""
        above = one + square * (k[0] + square * (k[1] + square * k[2]))
        below = one + square * (k[3] + square * (k[4] + square * k[5]))
        d_above = k[0] + square * (two * k[1] + three * square * k[2])
        d_below = k[3] + square * (two * k[4] + three * square * k[5])
        inverse = one / below
        c = above * inverse
        return c, (d_above - c * d_below) * inverse, below

    @wp.func
    def bend(p: wp.vec3d, k: lens_vector, limit: wp.float64):
        """Whether a point is seen, x' and y', and their Jacobian [2, 3]."""
        rz = one / p[2]
        x, y = p[0] * rz, p[1] * rz
        square = x * x + y * y
        c, slope, below = radial(square, k)
        bent = wp.vec2d(c * x, c * y)
        steep = two * slope
        xx, xy, yx, yy = c + x * x * steep, x * y * steep, x * y * steep, c + y * y * steep
        turned = c * (c + square * steep)
        if wp.static(not centred):
            bent = bent + wp.vec2d(
                two * k[6] * x * y + k[7] * (square + two * x * x) + square * (k[8] + square * k[9]),
                k[6] * (square + two * y * y) + two * k[7] * x * y + square * (k[10] + square * k[11]),
            )
            prism_x = two * (k[8] + two * square * k[9])
            prism_y = two * (k[10] + two * square * k[11])
            mixed = two * (k[6] * x + k[7] * y)
            xx = xx + two * k[6] * y + six * k[7] * x + prism_x * x
            xy = xy + mixed + prism_x * y
            yx = yx + mixed + prism_y * x
            yy = yy + six * k[6] * y + two * k[7] * x + prism_y * y
            turned = xx * yy - xy * yx
        # Written so that NaN is not seen.
        seen = p[2] > zero and square <= limit and below > zero and turned > zero
        J = mat23d(xx * rz, xy * rz, -rz * (xx * x + xy * y), yx * rz, yy * rz, -rz * (yx * x + yy * y))
        return seen, bent, J

    @wp.func
    def coefficient_gradient(p: wp.vec3d, k: lens_vector, v: wp.vec2d):
        """Gradient to the coefficients for the gradient v to x' and y'."""
        rz = one / p[2]
        x, y = p[0] * rz, p[1] * rz
        square = x * x + y * y
        c, _slope, below = radial(square, k)
        share = square * (v[0] * x + v[1] * y) / below
        g = lens_vector()
        for i in range(3):
            g[i] = share
            g[3 + i] = -c * share
            share = share * square
        if wp.static(not centred):
            g[6] = two * v[0] * x * y + v[1] * (square + two * y * y)
            g[7] = v[0] * (square + two * x * x) + two * v[1] * x * y
            g[8] = v[0] * square
            g[9] = v[0] * square * square
            g[10] = v[1] * square
            g[11] = v[1] * square * square
        return g

    @wp.func
    def radial_slope(angle: wp.float64, k: lens_vector):
        """Derivative of r' in r at tan(angle); not positive where the lens folds back or its fraction ends."""
        square = wp.tan(angle) * wp.tan(angle)
        c, slope, below = radial(square, k)
        result = c + two * square * slope
        if not below > zero:
            result = -one
        return result

    return bend, coefficient_gradient, radial_slope


def _angular(model: LensModel):
    zero, one, tiny = wp.float64(0.0), wp.float64(1.0), wp.float64(1.0e-30)
    fisheye, inverse, mapped = model == "fisheye", model == "ftheta_inverse", model in MAPPED

    @wp.func
    def polynomial(k: lens_vector, first: int, x: wp.float64):
        """That of six coefficients from one on, at x, and its derivative."""
        value, slope = zero, zero
        for i in range(6):
            slope = slope * x + value
            value = value * x + k[first + 5 - i]
        return value, slope

    @wp.func
    def distance(theta: wp.float64, k: lens_vector):
        """r' at an angle, and its derivative."""
        value, slope = zero, zero
        if wp.static(fisheye):
            s = theta * theta
            value = theta * (one + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
            three, five, seven, nine = wp.float64(3.0), wp.float64(5.0), wp.float64(7.0), wp.float64(9.0)
            slope = one + s * (three * k[0] + s * (five * k[1] + s * (seven * k[2] + s * nine * k[3])))
        elif wp.static(inverse):
            guess, _ = polynomial(k, 6, theta)
            value = guess
            steps = int(NEWTON_STEPS)  # in a variable: a loop, and no copies of it
            for _step in range(steps):
                angle, rise = polynomial(k, 0, value)
                value = value - (angle - theta) / rise
            _, rise = polynomial(k, 0, value)
            slope = one / rise
        else:
            value, slope = polynomial(k, 0, theta)
        return value, slope

    @wp.func
    def angle_of(p: wp.vec3d):
        """Distance from the axis, never zero, and the angle to it."""
        r = wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]), tiny)
        return r, wp.atan2(r, p[2])

    @wp.func
    def bend(p: wp.vec3d, k: lens_vector, limit: wp.float64):
        """Whether a point is seen, x' and y', and their Jacobian [2, 3]."""
        r, theta = angle_of(p)
        length, slope = distance(theta, k)
        w = length / r
        x, y = p[0] / r, p[1] / r
        squared = r * r + p[2] * p[2]
        along = slope * p[2] / squared  # dr' / dr
        fall = -slope / squared  # dr' / dz = fall r
        xx, xy, yy = w + x * x * (along - w), x * y * (along - w), w + y * y * (along - w)
        bent = wp.vec2d(length * x, length * y)
        J = mat23d(xx, xy, p[0] * fall, xy, yy, p[1] * fall)
        if wp.static(mapped):
            c, d, e = k[12], k[13], k[14]
            bent = wp.vec2d(c * bent[0] + d * bent[1], e * bent[0] + bent[1])
            row0, row1 = J[0], J[1]
            J[0] = c * row0 + d * row1
            J[1] = e * row0 + row1
        # Written so that NaN is not seen.
        seen = p[2] > zero and theta < limit and slope > zero and length >= zero
        return seen, bent, J

    @wp.func
    def coefficient_gradient(p: wp.vec3d, k: lens_vector, v: wp.vec2d):
        """Gradient to the coefficients for the gradient v to x' and y'."""
        r, theta = angle_of(p)
        x, y = p[0] / r, p[1] / r
        g = lens_vector()
        if wp.static(fisheye):
            share = (v[0] * x + v[1] * y) * theta
            for i in range(4):
                share = share * theta * theta
                g[i] = share
        else:
            length, slope = distance(theta, k)
            share = v[0] * (k[12] * x + k[13] * y) + v[1] * (k[14] * x + y)
            at = theta
            if wp.static(inverse):
                at = length
                share = -share * slope
            for i in range(6):
                g[i] = share
                share = share * at
            g[12] = v[0] * length * x
            g[13] = v[0] * length * y
            g[14] = v[1] * length * x
        return g

    @wp.func
    def radial_slope(angle: wp.float64, k: lens_vector):
        """Derivative of r' in θ; not positive where the lens folds back."""
        _value, slope = distance(angle, k)
        return slope

    return bend, coefficient_gradient, radial_slope
