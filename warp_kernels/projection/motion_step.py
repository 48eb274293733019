"""The step that makes motions of the two poses of a rolling shutter (see shutter_motion), and its adjoint.

With Q = R1 R0ᵀ, K = (Q - Qᵀ) / 2 has the axis times sin φ, and the trace of Q is 1 + 2 cos φ. [ω] = f K with
f = φ / sin φ. Colours are seen from half way between the two positions -Rᵀ t of the camera.
"""

import warp as wp

from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.shutter_motion import MOTION

STILL = 1.0e-8
"""sin² φ below which f is taken as 1 + sin² φ / 6."""


@made_once
def motion_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The forward kernel and the adjoint, one thread an image; all is computed in float64.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of poses and motions.

    Returns:
        ``(forward, adjoint)``.
    """
    mat44, motion_type = wp.types.matrix((4, 4), dtype), wp.types.vector(MOTION, dtype)
    half, one = wp.float64(0.5), wp.float64(1.0)

    @wp.func
    def rotation(view: mat44):
        R = wp.mat33d()
        for i in range(3):
            for j in range(3):
                R[i, j] = wp.float64(view[i, j])
        return R

    @wp.func
    def translation(view: mat44):
        return wp.vec3d(wp.float64(view[0, 3]), wp.float64(view[1, 3]), wp.float64(view[2, 3]))

    @wp.func
    def turn(R0: wp.mat33d, R1: wp.mat33d):
        """K, sin² φ, f and its derivatives in sin² φ and cos φ."""
        Q = R1 * wp.transpose(R0)
        K = half * (Q - wp.transpose(Q))
        square = K[2, 1] * K[2, 1] + K[0, 2] * K[0, 2] + K[1, 0] * K[1, 0]
        cosine = half * (Q[0, 0] + Q[1, 1] + Q[2, 2] - one)
        f, f_square, f_cosine = one + square / wp.float64(6.0), one / wp.float64(6.0), wp.float64(0.0)
        if square >= wp.float64(STILL):
            sine = wp.sqrt(square)
            length = square + cosine * cosine
            f = wp.atan2(sine, cosine) / sine
            f_square = half * (cosine / length - f) / square
            f_cosine = -one / length
        return K, square, f, f_square, f_cosine

    @wp.kernel(name=f"make_motions_{dtype.__name__}", enable_backward=False, module="unique")
    def make_motions_kernel(
        viewmats: wp.array(dtype=mat44),  # [images], when the first line is read
        viewmats_rs: wp.array(dtype=mat44),  # [images], when the last one is
        # outputs
        motions: wp.array(dtype=motion_type),  # [images]
        half_way: wp.array(dtype=mat44),  # [images]
    ):
        image = wp.tid()
        view, end = viewmats[image], viewmats_rs[image]
        R0, R1, t0, t1 = rotation(view), rotation(end), translation(view), translation(end)
        K, square, f, _f_square, _f_cosine = turn(R0, R1)
        A1 = f * K * R0
        A2 = f * K * A1
        motion = motion_type()
        for i in range(3):
            for j in range(3):
                motion[3 * i + j] = dtype(R0[i, j])
                motion[9 + 3 * i + j] = dtype(A1[i, j])
                motion[18 + 3 * i + j] = dtype(A2[i, j])
            motion[27 + i] = dtype(t0[i])
            motion[30 + i] = dtype(t1[i] - t0[i])
        motion[33] = dtype(f * f * square)
        motions[image] = motion
        t = half * (R0 * (wp.transpose(R0) * t0 + wp.transpose(R1) * t1))  # -R0 times the mean of both positions
        middle = mat44(view)  # a copy: Warp writes through a view of an element
        for i in range(3):
            middle[i, 3] = dtype(t[i])
        half_way[image] = middle

    @wp.kernel(name=f"motion_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def motion_adjoint_kernel(
        viewmats: wp.array(dtype=mat44),  # [images]
        viewmats_rs: wp.array(dtype=mat44),  # [images]
        v_motions: wp.array(dtype=motion_type),  # [images]; [0]: zeros
        v_half_way: wp.array(dtype=mat44),  # [images]; [0]: zeros
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
        v_viewmats_rs: wp.array(dtype=mat44),  # [images]
    ):
        image = wp.tid()
        view, end = viewmats[image], viewmats_rs[image]
        R0, R1, t0, t1 = rotation(view), rotation(end), translation(view), translation(end)
        g_R0, g_R1, g_t0, g_t1 = wp.mat33d(), wp.mat33d(), wp.vec3d(), wp.vec3d()
        g_view, g_end = mat44(), mat44()
        if v_motions.shape[0] > 0:
            v = v_motions[image]
            g_A1, g_A2 = wp.mat33d(), wp.mat33d()
            for i in range(3):
                for j in range(3):
                    g_R0[i, j] = wp.float64(v[3 * i + j])
                    g_A1[i, j] = wp.float64(v[9 + 3 * i + j])
                    g_A2[i, j] = wp.float64(v[18 + 3 * i + j])
                g_t1[i] = wp.float64(v[30 + i])
                g_t0[i] = wp.float64(v[27 + i]) - g_t1[i]
            g_angle = wp.float64(v[33])
            K, square, f, f_square, f_cosine = turn(R0, R1)
            W = f * K
            A1 = W * R0
            g_A1 += wp.transpose(W) * g_A2
            g_W = g_A2 * wp.transpose(A1) + g_A1 * wp.transpose(R0)
            g_R0 += wp.transpose(W) * g_A1
            g_f = wp.ddot(g_W, K) + wp.float64(2.0) * f * square * g_angle
            g_square = f * f * g_angle + g_f * f_square
            # K is skew, and its entries below and above the diagonal are the same numbers.
            g_K = f * g_W + g_square * K
            g_Q = half * (g_K - wp.transpose(g_K))
            for i in range(3):
                g_Q[i, i] = half * g_f * f_cosine
            g_R1 += g_Q * R0
            g_R0 += wp.transpose(g_Q) * R1
        if v_half_way.shape[0] > 0:
            v_view = v_half_way[image]
            g = half * translation(v_view)
            g_positions = wp.transpose(R0) * g  # to R0ᵀ t0 and R1ᵀ t1
            g_R0 += rotation(v_view) + wp.outer(g, wp.transpose(R0) * t0 + wp.transpose(R1) * t1)
            g_R0 += wp.outer(t0, g_positions)
            g_R1 += wp.outer(t1, g_positions)
            g_t0 += R0 * g_positions
            g_t1 += R1 * g_positions
            for j in range(4):
                g_view[3, j] = v_view[3, j]
        for i in range(3):
            for j in range(3):
                g_view[i, j] = dtype(g_R0[i, j])
                g_end[i, j] = dtype(g_R1[i, j])
            g_view[i, 3] = dtype(g_t0[i])
            g_end[i, 3] = dtype(g_t1[i])
        v_viewmats[image] = g_view
        v_viewmats_rs[image] = g_end

    return make_motions_kernel, motion_adjoint_kernel


def make_motions(viewmats: wp.array, viewmats_rs: wp.array, motions: wp.array, half_way: wp.array) -> None:
    """Motions between two poses.

    Args:
        viewmats: mat44 [images], poses when the first line is read.
        viewmats_rs: mat44 [images], poses when the last one is, less than half a turn away.
        motions: vec [images] of ``MOTION`` numbers, output.
        half_way: mat44 [images], the first poses at the mean of both positions, output.
    """
    kernel, _ = motion_kernels(viewmats.dtype._wp_scalar_type_)
    launch_again(kernel, viewmats.shape[0], [viewmats, viewmats_rs, motions, half_way], viewmats.device)


def make_motions_adjoint(
    viewmats: wp.array,
    viewmats_rs: wp.array,
    v_motions: wp.array | None,
    v_half_way: wp.array | None,
    v_viewmats: wp.array,
    v_viewmats_rs: wp.array,
) -> None:
    """The adjoint of ``make_motions``.

    Args:
        v_motions: gradient to the motions; None: zeros.
        v_half_way: gradient to the poses half way; None: zeros.
        v_viewmats: mat44 [images], is written.
    """
    _, kernel = motion_kernels(viewmats.dtype._wp_scalar_type_)
    inputs = [viewmats, viewmats_rs, v_motions, v_half_way, v_viewmats, v_viewmats_rs]
    launch_again(kernel, viewmats.shape[0], inputs, viewmats.device)
