"""Adjoint of affine_cameras, written by hand; notation as there.

One thread per Gaussian walks the cameras of its scene and sums its own gradient; gradients to cameras are records that
are summed afterwards, as in projection_adjoint. Each of the seven points takes its share of the gradients to the mean
and the a_i back through the lens by its own Jacobian.

With a rolling shutter the time depends on where the point lands. For u = π(V(τ) x), τ = s · u and the pace w = ∂u / ∂τ,
a gradient v to u is one of v + s (w · v) / (1 - s · w) to π(V(τ) x) at that time.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.strand_sums import STRANDS
from warp_kernels.projection.affine_cameras import SPREAD, loading_functions, sight_functions
from warp_kernels.projection.camera_gradients import CAMERA_RECORD
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel, lens_functions, lens_vector
from warp_kernels.projection.rotation import rotation_functions
from warp_kernels.projection.shutter_motion import MOTION, mat34d, motion_vector, pose_functions

STILL_RECORD = 12 + 4 + LENS_COEFFS
"""Numbers of a record: the first three rows of a view matrix, fx, fy, cx, cy, the coefficients of the lens."""

ROLLING_RECORD = MOTION + 4 + LENS_COEFFS
"""The same with a motion in place of the view matrix."""


@made_once
def affine_camera_adjoint_kernel(dtype: type, model: LensModel, rolling: bool, to_cameras: bool) -> wp.Kernel:
    """The adjoint kernel, one thread a Gaussian of a scene.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
        model: of the lenses.
        rolling: Lines are read out at different times.
        to_cameras: Also write gradients to poses, intrinsics and lenses.

    Returns:
        The Warp kernel.
    """
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    affine_record = wp.types.vector(CAMERA_RECORD, dtype)
    poses = MOTION if rolling else 12
    record = wp.types.vector(ROLLING_RECORD if rolling else STILL_RECORD, dtype)
    pose_kind = motion_vector if rolling else mat34d
    intrinsics, sight = sight_functions(model, rolling)
    pose_of, lens_of, axes_of = loading_functions(dtype, rolling)
    _, velocity, turned_back, pose_gradient = pose_functions(rolling)
    bend, coefficient_gradient, _ = lens_functions(model)
    to_matrix, turn_adjoint = rotation_functions(dtype)
    zero, half, one, spread = (wp.float64(x) for x in (0.0, 0.5, 1.0, SPREAD))
    in_pixels = model in ("ftheta", "ftheta_inverse")

    @wp.kernel(
        name=f"affine_camera_adjoint_{model}{'_rolling' * rolling}{'_cameras' * to_cameras}_{dtype.__name__}",
        enable_backward=False,
        module="unique",
    )
    def affine_camera_adjoint_kernel(
        first: int,
        num_gaussians: int,
        num_cameras: int,
        means: wp.array(dtype=vec3),  # [scenes · N]
        quats: wp.array(dtype=vec4),  # [scenes · N]
        scales: wp.array(dtype=vec3),  # [scenes · N]
        viewmats: wp.array(dtype=mat44),  # [images]
        motions: wp.array(dtype=motion_type),  # [images]; [0] without a rolling shutter
        Ks: wp.array(dtype=mat33),  # [images]
        coefficients: wp.array(dtype=coefficients_type),  # [images]
        limits: wp.array(dtype=wp.float64),  # [images]
        shutter_x: wp.float64,
        shutter_y: wp.float64,
        shutter_start: wp.float64,
        radii: wp.array(dtype=wp.vec2i),  # [images · N]
        v_affine: wp.array(dtype=affine_record),  # [images · N]; see camera_gradients
        store: bool,
        store_means: bool,
        # outputs
        v_means: wp.array(dtype=vec3),  # [scenes · N]
        v_quats: wp.array(dtype=vec4),  # [scenes · N]
        v_scales: wp.array(dtype=vec3),  # [scenes · N]
        v_cameras: wp.array(dtype=record),  # [images · N]; [0]: not wanted
    ):
        gaussian = wp.tid() + first
        scene = gaussian // num_gaussians
        shutter = wp.vec3d(shutter_x, shutter_y, shutter_start)
        raw, s, mean = quats[gaussian], scales[gaussian], means[gaussian]
        m = wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]))
        axes = axes_of(raw, s)
        g_mean = wp.vec3d()
        g_axes = wp.mat33d()  # rows
        given = bool(True)
        for camera in range(num_cameras):
            image = scene * num_cameras + camera
            index = image * num_gaussians + gaussian % num_gaussians
            g_pose, g_K, g_lens = pose_kind(), wp.vec4d(), lens_vector()
            if radii[index][0] > 0:
                v = v_affine[index]
                given = given and wp.isfinite(v)
                v_mean2d = wp.vec2d(wp.float64(v[9]), wp.float64(v[10]))
                raw_K = Ks[image]
                K = intrinsics(
                    wp.float64(raw_K[0, 0]), wp.float64(raw_K[1, 1]), wp.float64(raw_K[0, 2]), wp.float64(raw_K[1, 2])
                )
                pose, k, limit = pose_of(viewmats, motions, image), lens_of(coefficients, image), limits[image]
                time = wp.float64(0.5)
                points = int(7)  # in a variable: a loop, and no copies of it
                for point in range(points):  # the mean, and on both sides of it along the axes
                    axis = wp.max((point - 1) // 2, 0)
                    away = wp.float64(0.0)
                    v_u = (one - wp.float64(3.0) / (spread * spread)) * v_mean2d
                    if point > 0:
                        away = wp.float64(spread)
                        if (point - 1) % 2 == 1:
                            away = -away
                        v_slope = wp.vec2d(wp.float64(v[axis]), wp.float64(v[3 + axis]))
                        v_u = (half / (spread * spread)) * v_mean2d + (half / away) * v_slope
                    place = m + away * axes[axis]
                    _seen, _u, J, x, tau, pace, left = sight(pose, place, K, k, limit, shutter, time)
                    v_depth = wp.float64(0.0)
                    if point == 0:
                        time = tau
                        v_depth = wp.float64(v[11])
                    if wp.static(rolling):
                        along = wp.vec2d(shutter[0], shutter[1])
                        rate = velocity(pose, place, tau)
                        v_u += (v_depth * rate[2]) * along
                        v_u += (wp.dot(pace, v_u) / left) * along
                    v_x = wp.transpose(J) * v_u + wp.vec3d(zero, zero, v_depth)
                    v_place = turned_back(pose, tau, v_x)
                    g_mean += v_place
                    g_axes[axis] = g_axes[axis] + away * v_place
                    if wp.static(to_cameras):
                        g_pose += pose_gradient(pose, place, tau, v_x)
                        _seen, bent, _J = bend(x, k, limit)
                        g_K += wp.vec4d(v_u[0] * bent[0], v_u[1] * bent[1], v_u[0], v_u[1])
                        g_lens += coefficient_gradient(x, k, wp.vec2d(K[0] * v_u[0], K[1] * v_u[1]))
            if wp.static(to_cameras):
                G = record()
                if wp.static(rolling):
                    for i in range(wp.static(MOTION)):
                        G[i] = dtype(g_pose[i])
                else:
                    for i in range(3):
                        for j in range(4):
                            G[4 * i + j] = dtype(g_pose[i, j])
                if wp.static(not in_pixels):
                    G[poses] = dtype(g_K[0])
                    G[poses + 1] = dtype(g_K[1])
                G[poses + 2] = dtype(g_K[2])
                G[poses + 3] = dtype(g_K[3])
                for i in range(wp.static(LENS_COEFFS)):
                    G[poses + 4 + i] = dtype(g_lens[i])
                # A gradient too large for its type: none at all, rather than an infinity that ends an optimisation.
                if given and not wp.isfinite(G):
                    G = record()
                v_cameras[index] = G

        rotation = to_matrix(raw)
        columns = wp.transpose(rotation)
        g_scale = vec3()
        V = wp.mat33d()  # columns: gradients to those of the rotation
        for i in range(3):
            g_scale[i] = dtype(wp.dot(columns[i], g_axes[i]))
            for j in range(3):
                V[j, i] = wp.float64(s[i]) * g_axes[i, j]
        W = columns * V
        turn = vec3(dtype(W[2, 1] - W[1, 2]), dtype(W[0, 2] - W[2, 0]), dtype(W[1, 0] - W[0, 1]))
        g_quat = turn_adjoint(raw, turn)
        own = vec3(dtype(g_mean[0]), dtype(g_mean[1]), dtype(g_mean[2]))
        held = wp.isfinite(own) and wp.isfinite(g_scale) and wp.isfinite(g_quat)
        if given and not held:
            own, g_scale, g_quat = vec3(), vec3(), vec4()
        if not store_means:
            own = v_means[gaussian] + own
        if not store:
            g_scale = v_scales[gaussian] + g_scale
            g_quat = v_quats[gaussian] + g_quat
        v_means[gaussian] = own
        v_scales[gaussian] = g_scale
        v_quats[gaussian] = g_quat

    return affine_camera_adjoint_kernel


@made_once
def lens_finish_kernel(dtype: type, rolling: bool) -> wp.Kernel:
    """Adds the strands of each image and hands the result to the gradients, one thread an image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.
        rolling: The records begin with motions.

    Returns:
        The Warp kernel.
    """
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    poses = MOTION if rolling else 12
    record64 = wp.types.vector(ROLLING_RECORD if rolling else STILL_RECORD, wp.float64)

    @wp.kernel(
        name=f"finish_lens_gradients{'_rolling' * rolling}_{dtype.__name__}", enable_backward=False, module="unique"
    )
    def finish_lens_gradients_kernel(
        partial_sums: wp.array(dtype=record64),  # [images · STRANDS]
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
        v_motions: wp.array(dtype=motion_type),  # [images]; [0] without a rolling shutter
        v_Ks: wp.array(dtype=mat33),  # [images]
        v_coefficients: wp.array(dtype=coefficients_type),  # [images]
    ):
        image = wp.tid()
        total = record64()
        for strand in range(wp.static(STRANDS)):
            total = total + partial_sums[image * wp.static(STRANDS) + strand]
        if wp.static(rolling):
            motion = v_motions[image]
            for i in range(wp.static(MOTION)):
                motion[i] = motion[i] + dtype(total[i])
            v_motions[image] = motion
        else:
            view = v_viewmats[image]
            for i in range(3):
                for j in range(4):
                    view[i, j] = view[i, j] + dtype(total[4 * i + j])
            v_viewmats[image] = view
        K = v_Ks[image]
        K[0, 0] = K[0, 0] + dtype(total[poses])
        K[1, 1] = K[1, 1] + dtype(total[poses + 1])
        K[0, 2] = K[0, 2] + dtype(total[poses + 2])
        K[1, 2] = K[1, 2] + dtype(total[poses + 3])
        v_Ks[image] = K
        v = v_coefficients[image]
        for i in range(wp.static(LENS_COEFFS)):
            v[i] = v[i] + dtype(total[poses + 4 + i])
        v_coefficients[image] = v

    return finish_lens_gradients_kernel
