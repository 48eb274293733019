"""Where a camera is while a rolling shutter reads its image out: its pose at a time between 0 and 1.

The rotation turns at an even rate about one axis (slerp), the translation of the view matrix moves along a line, as in
gsplat. With ω the rotation vector of R1 R0ᵀ, φ = |ω| and [ω] the matrix of the cross product with ω (Rodrigues),

    R(τ) = A0 + sin(τ φ) / φ · A1 + (1 - cos(τ φ)) / φ² · A2,   A0 = R0, A1 = [ω] R0, A2 = [ω]² R0.

A motion is a record of ``MOTION`` numbers: A0, A1 and A2 by rows, t0, t1 - t0 and φ². A camera that stands still has
the rows of its view matrix, a pose [3, 4].
"""

import warp as wp

from warp_kernels.machinery.loading import made_once

MOTION = 34
"""Numbers of a motion."""

motion_vector = wp.types.vector(MOTION, wp.float64)
mat34d = wp.types.matrix((3, 4), wp.float64)


@wp.func
def turned(pose: motion_vector, first: int, m: wp.vec3d):
    """A row-major 3 x 3 matrix in a motion, times a vector."""
    result = wp.vec3d()
    for i in range(3):
        for j in range(3):
            result[i] += pose[first + 3 * i + j] * m[j]
    return result


SMALL = 1.0e-4
"""(τ φ)² below which series are exact, to 1e-15."""


@wp.func
def turn_weights(square: wp.float64, tau: wp.float64):
    """sin(τ φ) / φ and (1 - cos(τ φ)) / φ²."""
    one = wp.float64(1.0)
    x = square * tau * tau
    s = tau * (one - x / wp.float64(6.0) * (one - x / wp.float64(20.0) * (one - x / wp.float64(42.0))))
    c = tau * tau * wp.float64(0.5)
    c *= one - x / wp.float64(12.0) * (one - x / wp.float64(30.0) * (one - x / wp.float64(56.0)))
    if x > wp.float64(SMALL):
        phi = wp.sqrt(square)
        s, c = wp.sin(tau * phi) / phi, (one - wp.cos(tau * phi)) / square
    return s, c


@wp.func
def turn_bends(square: wp.float64, tau: wp.float64):
    """Derivatives of both weights in φ²."""
    one, two = wp.float64(1.0), wp.float64(2.0)
    x = square * tau * tau
    s_square = -tau * tau * tau / wp.float64(6.0)
    s_square *= one - x / wp.float64(10.0) * (one - x / wp.float64(28.0))
    c_square = -tau * tau * tau * tau / wp.float64(24.0)
    c_square *= one - x / wp.float64(15.0) * (one - x / wp.float64(112.0 / 3.0))
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
        ``(position, velocity, turned_back, pose_gradient)``, Warp functions in float64 of a pose, a point of the world
        and a time.
    """
    pose_kind = motion_vector if rolling else mat34d

    @wp.func
    def position(pose: pose_kind, m: wp.vec3d, tau: wp.float64):
        x = wp.vec3d()
        if wp.static(rolling):
            s, c = turn_weights(pose[33], tau)
            x = turned(pose, 0, m) + s * turned(pose, 9, m) + c * turned(pose, 18, m)
            for i in range(3):
                x[i] += pose[27 + i] + tau * pose[30 + i]
        else:
            x = pose * wp.vec4d(m[0], m[1], m[2], wp.float64(1.0))
        return x

    @wp.func
    def velocity(pose: pose_kind, m: wp.vec3d, tau: wp.float64):
        """Derivative of the position in the time."""
        x = wp.vec3d()
        if wp.static(rolling):
            s, _c = turn_weights(pose[33], tau)
            x = wp.cos(tau * wp.sqrt(pose[33])) * turned(pose, 9, m) + s * turned(pose, 18, m)
            for i in range(3):
                x[i] += pose[30 + i]
        return x

    @wp.func
    def turned_back(pose: pose_kind, tau: wp.float64, v: wp.vec3d):
        """The gradient v to a position in camera axes, as one to the point of the world: R(τ)ᵀ v."""
        result = wp.vec3d()
        if wp.static(rolling):
            s, c = turn_weights(pose[33], tau)
            for i in range(3):
                for j in range(3):
                    result[j] += (pose[3 * i + j] + s * pose[9 + 3 * i + j] + c * pose[18 + 3 * i + j]) * v[i]
        else:
            for i in range(3):
                for j in range(3):
                    result[j] += pose[i, j] * v[i]
        return result

    @wp.func
    def pose_gradient(pose: pose_kind, m: wp.vec3d, tau: wp.float64, v: wp.vec3d):
        """The gradient v to a position, as one to the pose."""
        g = pose_kind()
        if wp.static(rolling):
            s, c = turn_weights(pose[33], tau)
            s_square, c_square = turn_bends(pose[33], tau)
            for i in range(3):
                for j in range(3):
                    outer = v[i] * m[j]
                    g[3 * i + j] = outer
                    g[9 + 3 * i + j] = s * outer
                    g[18 + 3 * i + j] = c * outer
                g[27 + i] = v[i]
                g[30 + i] = tau * v[i]
            g[33] = s_square * wp.dot(v, turned(pose, 9, m)) + c_square * wp.dot(v, turned(pose, 18, m))
        else:
            for i in range(3):
                for j in range(3):
                    g[i, j] = v[i] * m[j]
                g[i, 3] = v[i]
        return g

    return position, velocity, turned_back, pose_gradient
