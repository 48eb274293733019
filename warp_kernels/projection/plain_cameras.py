"""Cameras without a lens: where they see a point, the Jacobian of that, and the adjoint of both.

With the position p = (x, y, z) in camera axes, r² = x² + y² and ρ² = r² + z²:

- pinhole: u = fx x / z + cx, v = fy y / z + cy. The Jacobian is evaluated at x / z and y / z no farther outside of the
  image than FOV_MARGIN.
- ortho: u = fx x + cx, v = fy y + cy.
- fisheye: u = fx x w + cx, v = fy y w + cy with w = θ / r, θ = atan2(r, z) the angle to the axis: distances in the
  image are proportional to angles, as in gsplat's fisheye camera. With g = (z / ρ² - w) / r²,

      J = [fx (w + g x²), fx g x y, -fx x / ρ²;  fy g x y, fy (w + g y²), -fy y / ρ²]

  and the derivatives of what J consists of are

      ∂w = (g x, g y, -1 / ρ²),   ∂g = (m x, m y, 2 / ρ⁴),   ∂(1 / ρ²) = -2 / ρ⁴ (x, y, z),
      m = -(2 z / ρ⁴ + 3 g) / r².
"""

from typing import Literal

import warp as wp

from warp_kernels.constants import FOV_MARGIN
from warp_kernels.machinery.loading import made_once

CameraModel = Literal["pinhole", "ortho", "fisheye"]

NEAR_AXIS = 1.0e-4
"""Below this r² / z², g and m of a fisheye camera are series in it, whose next terms are below rounding. Their closed
forms are differences of numbers that come close: here g has lost 4 of its 16 digits, and m 8, of a small share."""


@made_once
def plain_camera_functions(dtype: type, camera_model: CameraModel):
    """Straight-line pieces that the projection and its adjoint share.

    Returns:
        ``(camera_position, camera_axes, jacobian, project_mean, position_adjoint)``, Warp functions. The first two are
        the same for all models.
    """
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    if camera_model == "fisheye":
        sight, jacobian, position_adjoint = _fisheye(dtype)
    else:
        sight, jacobian, position_adjoint = _pinhole(dtype) if camera_model == "pinhole" else _ortho(dtype)

    @wp.func
    def camera_position(view: mat44, mean: vec3):
        """p = R m + t in float64: far from the origin the terms are large and cancel."""
        x = wp.vec4d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]), wp.float64(1.0))
        p = wp.vec3d()
        for i in range(3):
            for j in range(4):
                p[i] += wp.float64(view[i, j]) * x[j]
        return p

    @wp.func
    def camera_axes(view: mat44):
        """R in float64."""
        R = wp.mat33d()
        for i in range(3):
            for j in range(3):
                R[i, j] = wp.float64(view[i, j])
        return R

    @wp.func
    def project_mean(p: wp.vec3d, K: mat33):
        """Image position [px] of a camera-space point, and what rounding took from it, an error of all pixels."""
        w = sight(p)
        u = wp.float64(K[0, 0]) * p[0] * w + wp.float64(K[0, 2])
        v = wp.float64(K[1, 1]) * p[1] * w + wp.float64(K[1, 2])
        mean2d = vec2(dtype(u), dtype(v))
        return mean2d, vec2(dtype(u - wp.float64(mean2d[0])), dtype(v - wp.float64(mean2d[1])))

    return camera_position, camera_axes, jacobian, project_mean, position_adjoint


def _pinhole(dtype: type):
    """``(sight, jacobian, position_adjoint)``, as of the models below.

    ``sight`` is what x and y are multiplied with; ``jacobian`` is J [2, 3] in float64, and ``position_adjoint`` makes
    of gradients to the position in the image and to J those to p and to (fx, fy, cx, cy).
    """
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    mat23, mat33 = wp.types.matrix((2, 3), dtype), wp.types.matrix((3, 3), dtype)
    mat23d = wp.types.matrix((2, 3), wp.float64)
    zero, half, one, two, margin = (dtype(x) for x in (0.0, 0.5, 1.0, 2.0, FOV_MARGIN))
    zero64 = wp.float64(0.0)

    @wp.func
    def sight(p: wp.vec3d):
        return wp.float64(1.0) / p[2]

    @wp.func
    def fov_limits(focal: dtype, center: dtype, size: dtype):
        """Smallest and largest x / z (or y / z) at which the Jacobian is evaluated."""
        spare = margin * half * size
        inverse = one / focal
        return -(center + spare) * inverse, (size - center + spare) * inverse

    @wp.func
    def jacobian(p: wp.vec3d, K: mat33, width: int, height: int):
        fx, fy = wp.float64(K[0, 0]), wp.float64(K[1, 1])
        low_x, high_x = fov_limits(K[0, 0], K[0, 2], dtype(width))
        low_y, high_y = fov_limits(K[1, 1], K[1, 2], dtype(height))
        rz = wp.float64(1.0) / p[2]
        x = wp.clamp(p[0] * rz, wp.float64(low_x), wp.float64(high_x))
        y = wp.clamp(p[1] * rz, wp.float64(low_y), wp.float64(high_y))
        return mat23d(fx * rz, zero64, -fx * rz * x, zero64, fy * rz, -fy * rz * y)

    @wp.func
    def clamp_adjoint(position: dtype, depth: dtype, focal: dtype, center: dtype, size: dtype, v: dtype):
        """Gradient v to t = z · clamp(x / z, low, high), passed on to x, z, focal length and principal point."""
        low, high = fov_limits(focal, center, size)
        ratio = position / depth
        v_position, v_depth, v_focal, v_center = v, zero, zero, zero
        if ratio < low or ratio > high:
            limit = wp.clamp(ratio, low, high)
            v_position = zero
            v_depth = v * limit
            v_focal = -v * depth * limit / focal
            v_center = -v * depth / focal
        return v_position, v_depth, v_focal, v_center

    @wp.func
    def position_adjoint(exact: wp.vec3d, K: mat33, J: mat23, v_xy: vec2, v_J: mat23, width: int, height: int):
        p = vec3(dtype(exact[0]), dtype(exact[1]), dtype(exact[2]))
        fx = K[0, 0]
        fy = K[1, 1]
        rz = one / p[2]
        rz2 = rz * rz
        # t = clamped position; J[0, 2] = -fx tx / z²
        tx = -J[0, 2] * p[2] * p[2] / fx
        ty = -J[1, 2] * p[2] * p[2] / fy
        v_fx = p[0] * rz * v_xy[0] + rz * v_J[0, 0] - tx * rz2 * v_J[0, 2]
        v_fy = p[1] * rz * v_xy[1] + rz * v_J[1, 1] - ty * rz2 * v_J[1, 2]
        x_x, x_z, x_f, x_c = clamp_adjoint(p[0], p[2], fx, K[0, 2], dtype(width), -fx * rz2 * v_J[0, 2])
        y_y, y_z, y_f, y_c = clamp_adjoint(p[1], p[2], fy, K[1, 2], dtype(height), -fy * rz2 * v_J[1, 2])
        v_z = (
            -(fx * p[0] * v_xy[0] + fy * p[1] * v_xy[1]) * rz2
            - (fx * v_J[0, 0] + fy * v_J[1, 1]) * rz2
            + two * (fx * tx * v_J[0, 2] + fy * ty * v_J[1, 2]) * rz2 * rz
            + x_z
            + y_z
        )
        v_p = vec3(fx * rz * v_xy[0] + x_x, fy * rz * v_xy[1] + y_y, v_z)
        return v_p, vec4(v_fx + x_f, v_fy + y_f, v_xy[0] + x_c, v_xy[1] + y_c)

    return sight, jacobian, position_adjoint


def _ortho(dtype: type):
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    mat23, mat33 = wp.types.matrix((2, 3), dtype), wp.types.matrix((3, 3), dtype)
    mat23d = wp.types.matrix((2, 3), wp.float64)
    zero, zero64 = dtype(0.0), wp.float64(0.0)

    @wp.func
    def sight(p: wp.vec3d):
        return wp.float64(1.0)

    @wp.func
    def jacobian(p: wp.vec3d, K: mat33, width: int, height: int):
        return mat23d(wp.float64(K[0, 0]), zero64, zero64, zero64, wp.float64(K[1, 1]), zero64)

    @wp.func
    def position_adjoint(exact: wp.vec3d, K: mat33, J: mat23, v_xy: vec2, v_J: mat23, width: int, height: int):
        v_fx = dtype(exact[0]) * v_xy[0] + v_J[0, 0]
        v_fy = dtype(exact[1]) * v_xy[1] + v_J[1, 1]
        return vec3(K[0, 0] * v_xy[0], K[1, 1] * v_xy[1], zero), vec4(v_fx, v_fy, v_xy[0], v_xy[1])

    return sight, jacobian, position_adjoint


def _fisheye(dtype: type):
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    mat23, mat33 = wp.types.matrix((2, 3), dtype), wp.types.matrix((3, 3), dtype)
    mat23d = wp.types.matrix((2, 3), wp.float64)
    one, two, three, tiny, near_axis = (wp.float64(x) for x in (1.0, 2.0, 3.0, 1.0e-30, NEAR_AXIS))
    g0, g1, g2, g3 = (wp.float64((-1.0) ** k * 2 * k / (2 * k + 1)) for k in range(1, 5))
    m0, m1, m2 = (two * wp.float64(k) * g for k, g in ((1, g1), (2, g2), (3, g3)))

    @wp.func
    def sight(p: wp.vec3d):
        r = wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]), tiny)
        return wp.atan2(r, p[2]) / r

    @wp.func
    def slopes(p: wp.vec3d):
        """w, g, m and 1 / ρ²."""
        square = p[0] * p[0] + p[1] * p[1]
        inverse = one / (square + p[2] * p[2])
        w = sight(p)
        g = (p[2] * inverse - w) / square
        m = -(two * p[2] * inverse * inverse + three * g) / square
        if square < near_axis * p[2] * p[2] and p[2] > wp.float64(0.0):
            rz = one / p[2]
            s = square * rz * rz
            g = (g0 + s * (g1 + s * (g2 + s * g3))) * rz * rz * rz
            m = (m0 + s * (m1 + s * m2)) * rz * rz * rz * rz * rz
        return w, g, m, inverse

    @wp.func
    def bare(p: wp.vec3d, w: wp.float64, g: wp.float64, inverse: wp.float64):
        """J of focal lengths of 1."""
        mixed = g * p[0] * p[1]
        return mat23d(
            w + g * p[0] * p[0], mixed, -p[0] * inverse,
            mixed, w + g * p[1] * p[1], -p[1] * inverse,
        )  # fmt: skip

    @wp.func
    def jacobian(p: wp.vec3d, K: mat33, width: int, height: int):
        w, g, _m, inverse = slopes(p)
        J = bare(p, w, g, inverse)
        J[0] = wp.float64(K[0, 0]) * J[0]
        J[1] = wp.float64(K[1, 1]) * J[1]
        return J

    @wp.func
    def position_adjoint(p: wp.vec3d, K: mat33, J: mat23, v_xy: vec2, v_J: mat23, width: int, height: int):
        w, g, m, inverse = slopes(p)
        fx, fy = wp.float64(K[0, 0]), wp.float64(K[1, 1])
        v_u, v_v = wp.float64(v_xy[0]), wp.float64(v_xy[1])
        v = mat23d(v_J)
        J1 = bare(p, w, g, inverse)
        v_fx = p[0] * w * v_u + wp.dot(J1[0], v[0])
        v_fy = p[1] * w * v_v + wp.dot(J1[1], v[1])
        # gradients to the entries of J without focal lengths, and by way of them to w, g and 1 / ρ²
        v[0] = fx * v[0]
        v[1] = fy * v[1]
        x, y = p[0], p[1]
        both = v[0, 1] + v[1, 0]
        v_w = v[0, 0] + v[1, 1]
        v_g = x * x * v[0, 0] + x * y * both + y * y * v[1, 1]
        v_inverse = -x * v[0, 2] - y * v[1, 2]
        beside = g * v_w + m * v_g - two * inverse * inverse * v_inverse
        v_p = wp.transpose(J1) * wp.vec2d(fx * v_u, fy * v_v)
        v_p += wp.vec3d(
            beside * x + g * (two * x * v[0, 0] + y * both) - inverse * v[0, 2],
            beside * y + g * (two * y * v[1, 1] + x * both) - inverse * v[1, 2],
            inverse * (two * inverse * (v_g - p[2] * v_inverse) - v_w),
        )
        return vec3(v_p), vec4(dtype(v_fx), dtype(v_fy), v_xy[0], v_xy[1])

    return sight, jacobian, position_adjoint
