"""Where a camera is while a rolling shutter reads its image out: its pose at a time between 0 and 1.

The rotation turns at an even rate about one axis (slerp), the translation of the view matrix moves along a line, as in
gsplat. With ω the rotation vector of R1 R0ᵀ, φ = |ω| and [ω] the matrix of the cross product with ω (Rodrigues),

    R(τ) = A0 + sin(τ φ) / φ · A1 + (1 - cos(τ φ)) / φ² · A2,   A0 = R0, A1 = [ω] R0, A2 = [ω]² R0.

A motion is a record of ``MOTION`` numbers: A0, A1 and A2 by rows, t0, t1 - t0 and φ². A camera that stands still has
the rows of its view matrix, a pose [3, 4].

All that a motion has to do with a point m is its path: A0 m + t0, A1 m and A2 m, three rows, of which each time takes
the weights 1, sin(τ φ) / φ and (1 - cos(τ φ)) / φ². The path of a camera that stands still is one row.
"""

import math

import warp as wp

from warp_kernels.machinery.loading import made_once

MOTION = 34
"""Numbers of a motion."""

TERMS = 8
"""Of the series below; the first that is left out is 1e-19 of the first one."""

SMALL = 0.25
"""(τ φ)² up to which the series are taken: half a radian, more than cameras turn while they are read out."""

motion_vector = wp.types.vector(MOTION, wp.float64)
mat34d = wp.types.matrix((3, 4), wp.float64)
series_vector = wp.types.vector(TERMS, wp.float64)

SINE = wp.constant(series_vector(*((-1) ** n / math.factorial(2 * n + 1) for n in range(TERMS))))
COSINE = wp.constant(series_vector(*((-1) ** n / math.factorial(2 * n + 2) for n in range(TERMS))))
SINE_BEND = wp.constant(series_vector(*((-1) ** n * n / math.factorial(2 * n + 1) for n in range(1, TERMS + 1))))
COSINE_BEND = wp.constant(series_vector(*((-1) ** n * n / math.factorial(2 * n + 2) for n in range(1, TERMS + 1))))


@wp.func
def series(coefficients: series_vector, x: wp.float64):
    """A polynomial."""
    value = wp.float64(0.0)
    for i in range(TERMS):
        value = value * x + coefficients[TERMS - 1 - i]
    return value


@wp.func
def turn_weights(square: wp.float64, tau: wp.float64):
    """sin(τ φ) / φ and (1 - cos(τ φ)) / φ²."""
    x = square * tau * tau
    s, c = tau * series(SINE, x), tau * tau * series(COSINE, x)
    if x > wp.float64(SMALL):
        phi = wp.sqrt(square)
        s, c = wp.sin(tau * phi) / phi, (wp.float64(1.0) - wp.cos(tau * phi)) / square
    return s, c


@wp.func
def turn_bends(square: wp.float64, tau: wp.float64):
    """Derivatives of both weights in φ²."""
    two = wp.float64(2.0)
    x = square * tau * tau
    cube = tau * tau * tau
    s_square, c_square = cube * series(SINE_BEND, x), tau * cube * series(COSINE_BEND, x)
    if x > wp.float64(SMALL):
        s, c = turn_weights(square, tau)
        s_square = (tau * wp.cos(tau * wp.sqrt(square)) - s) / (two * square)
        c_square = (tau * s - two * c) / (two * square)
    return s_square, c_square


@made_once
def pose_functions(rolling: bool):
    """Where a point is in camera axes.

    Args:
        rolling: The pose is a motion; else the rows of a view matrix.

    Returns:
        ``(turned, begin, drift, weights, position, velocity)``, Warp functions in float64. ``turned`` makes the path of
        a difference of points; that of a point also has ``begin`` in its first row. ``drift`` is t1 - t0, ``weights``
        are those of a path at a time. A path, the weights of a time, the drift and the time give position and velocity.
    """
    pose_kind, rows = motion_vector if rolling else mat34d, path_rows(rolling)
    path_kind = wp.types.matrix((rows, 3), wp.float64)
    one = wp.float64(1.0)

    @wp.func
    def turned(pose: pose_kind, v: wp.vec3d):
        path = path_kind()
        for r in range(wp.static(rows)):
            for i in range(3):
                for j in range(3):
                    if wp.static(rolling):
                        path[r, i] += pose[9 * r + 3 * i + j] * v[j]
                    else:
                        path[r, i] += pose[i, j] * v[j]
        return path

    @wp.func
    def begin(pose: pose_kind):
        if wp.static(rolling):
            return wp.vec3d(pose[27], pose[28], pose[29])
        else:
            return wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])

    @wp.func
    def drift(pose: pose_kind):
        if wp.static(rolling):
            return wp.vec3d(pose[30], pose[31], pose[32])
        else:
            return wp.vec3d()

    @wp.func
    def weights(pose_square: wp.float64, tau: wp.float64):
        result = wp.vec3d(one, wp.float64(0.0), wp.float64(0.0))
        if wp.static(rolling):
            s, c = turn_weights(pose_square, tau)
            result = wp.vec3d(one, s, c)
        return result

    @wp.func
    def position(path: path_kind, w: wp.vec3d, drifting: wp.vec3d, tau: wp.float64):
        x = path[0]
        if wp.static(rolling):
            x = x + w[1] * path[1] + w[2] * path[2] + tau * drifting
        return x

    @wp.func
    def velocity(path: path_kind, w: wp.vec3d, drifting: wp.vec3d, square: wp.float64):
        """Derivative of the position in the time. That of sin(τ φ) / φ is cos(τ φ) = 1 - φ² w[2]."""
        v = wp.vec3d()
        if wp.static(rolling):
            v = (one - square * w[2]) * path[1] + w[1] * path[2] + drifting
        return v

    return turned, begin, drift, weights, position, velocity


def path_rows(rolling: bool) -> int:
    """Rows of a point's path.

    Args:
        rolling: The camera moves while it is read out.
    """
    return 3 if rolling else 1
