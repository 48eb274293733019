"""Adjoint of affine_cameras, written by hand; notation as there, and for the ellipse as in projection.

One thread per Gaussian walks the cameras of its scene and sums its own gradient; gradients to cameras are summed over
each warp, and its records afterwards (see camera_gradients). Each of the seven points takes its share of the gradients
to the mean, the a_i and the h_i back through the lens by its own Jacobian, and adds them to the gradients to its path:
that of the mean, and that of its axis. The paths' gradients become those to the Gaussian and the pose at the end.

With a rolling shutter the time depends on where the point lands; the forward kernel has left it. For u = π(V(τ) x),
τ = s · u and the pace w = ∂u / ∂τ, a gradient v to u is one of v + s (w · v) / (1 - s · w) to π(V(τ) x) at that time.
"""

import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.lane_sums import lane_sum_function
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.affine_cameras import loading_functions, sight_functions
from warp_kernels.projection.camera_gradients import ROLLING_RECORD, STILL_RECORD
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel, lens_functions, lens_vector
from warp_kernels.projection.packed_roots import packed_root_functions
from warp_kernels.projection.rotation import rotation_functions
from warp_kernels.projection.shutter_motion import (
    MOTION,
    mat34d,
    motion_vector,
    path_rows,
    pose_functions,
    turn_bends,
)
from warp_kernels.projection.unscented_ellipse import SPREAD, ellipse_gradient_function, vec6d


@made_once
def affine_camera_adjoint_kernel(dtype: type, model: LensModel, rolling: bool, to_cameras: bool) -> wp.Kernel:
    """The adjoint kernel, one thread a Gaussian of a scene.

    Args:
        rolling: Lines are read out at different times.
        to_cameras: Also write gradients to poses, intrinsics and lenses.

    Returns:
        The Warp kernel, launched over ``WarpRows.threads``.
    """
    vec2, vec3, vec4, vec6 = (wp.types.vector(k, dtype) for k in (2, 3, 4, 6))
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    poses, length = MOTION if rolling else 12, ROLLING_RECORD if rolling else STILL_RECORD
    record, record64 = wp.types.vector(length, dtype), wp.types.vector(length, wp.float64)
    store_lane_sum = lane_sum_function(length)
    rows, pose_kind = path_rows(rolling), motion_vector if rolling else mat34d
    path_kind, paths_kind = (wp.types.matrix((count, 3), wp.float64) for count in (rows, 3 * rows))
    intrinsics, _ = sight_functions(dtype, model, rolling)
    turned, begin, drift, weights, position, velocity = pose_functions(rolling)
    pose_of, lens_of, axes_of = loading_functions(dtype, rolling)
    bend, coefficient_gradient, _ = lens_functions(model)
    to_matrix, turn_adjoint = rotation_functions(dtype)
    ellipse_gradient = ellipse_gradient_function(dtype)
    _, store3, store4 = store_functions(dtype)
    _, _, packed_row = packed_root_functions(dtype)
    zero, half, one, two, spread = (wp.float64(x) for x in (0.0, 0.5, 1.0, 2.0, SPREAD))
    in_pixels = model in ("ftheta", "ftheta_inverse")

    @wp.func
    def turned_back(pose: pose_kind, g: path_kind):
        """The gradient to a path, as one to the point or difference that it is of."""
        result = wp.vec3d()
        for r in range(wp.static(rows)):
            for i in range(3):
                for j in range(3):
                    if wp.static(rolling):
                        result[j] += pose[9 * r + 3 * i + j] * g[r, i]
                    else:
                        result[j] += pose[i, j] * g[r, i]
        return result

    @wp.func
    def turn_gradient(g: path_kind, v: wp.vec3d):
        """The gradient to the path of v, as one to the pose."""
        result = pose_kind()
        for r in range(wp.static(rows)):
            for i in range(3):
                for j in range(3):
                    if wp.static(rolling):
                        result[9 * r + 3 * i + j] = g[r, i] * v[j]
                    else:
                        result[i, j] = g[r, i] * v[j]
        return result

    @wp.kernel(
        name=f"affine_camera_adjoint_{model}{'_rolling' * rolling}{'_cameras' * to_cameras}_{dtype.__name__}",
        enable_backward=False,
        module="unique",
        launch_bounds=_launch_bounds(dtype, rolling),
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
        lanes: int,
        warps: int,
        eps2d: dtype,
        packed_roots: wp.array(dtype=vec4),  # [images · N]
        compensations: wp.array(dtype=dtype),  # [images · N]; [0] in the classic mode
        visible: wp.array(dtype=wp.bool),  # [images · N]
        slopes: wp.array2d(dtype=dtype),  # [12, images · N], and bows
        times: wp.array(dtype=wp.float64),  # [images · N]; [0] without a rolling shutter
        leads: wp.array2d(dtype=dtype),  # [6, images · N]; likewise
        v_means2d: wp.array(dtype=vec2),  # [images · N]; [0]: zeros, as in those below
        v_depths: wp.array(dtype=dtype),  # [images · N]
        v_roots: wp.array(dtype=vec3),  # [images · N]
        v_compensations: wp.array(dtype=dtype),  # [images · N]
        store: bool,
        store_means: bool,
        # outputs
        v_means: wp.array(dtype=vec3),  # [scenes · N]
        v_quats: wp.array(dtype=vec4),  # [scenes · N]
        v_scales: wp.array(dtype=vec3),  # [scenes · N]
        v_cameras: wp.array(dtype=record64),  # [images · warps]; [0]: not wanted
    ):
        thread = wp.tid() + first
        scene = thread // (warps * lanes)
        place = thread % (warps * lanes)
        inside = place < num_gaussians
        gaussian = scene * num_gaussians + wp.min(place, num_gaussians - 1)
        shutter = wp.vec3d(shutter_x, shutter_y, shutter_start)
        raw, s, mean = quats[gaussian], scales[gaussian], means[gaussian]
        m = wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]))
        axes = axes_of(raw, s)
        g_mean = wp.vec3d()
        g_axes = wp.mat33d()  # rows
        given = bool(True)
        for camera in range(num_cameras):
            image = scene * num_cameras + camera
            index = image * num_gaussians + gaussian - scene * num_gaussians
            G = record()
            if inside and visible[index]:
                # gradients that are not given are zero
                v_mean, v_depth_given, v_root, v_compensation, rho = vec2(), dtype(0.0), vec3(), dtype(0.0), dtype(0.0)
                if v_means2d.shape[0] > 0:
                    v_mean = v_means2d[index]
                if v_depths.shape[0] > 0:
                    v_depth_given = v_depths[index]
                if v_roots.shape[0] > 0:
                    v_root = v_roots[index]
                if v_compensations.shape[0] > 0:
                    v_compensation = v_compensations[index]
                    rho = compensations[index]
                finite = wp.isfinite(v_root) and wp.isfinite(v_mean) and wp.isfinite(v_depth_given)
                finite = finite and wp.isfinite(v_compensation)
                given = given and finite
                packed = packed_row(packed_roots, index)
                root = vec3(packed[0], packed[1], packed[2])
                slope, bow, lead = vec6d(), vec6d(), vec6()
                for i in range(6):
                    slope[i] = wp.float64(slopes[i, index])
                    bow[i] = wp.float64(slopes[6 + i, index])
                    if wp.static(rolling):
                        lead[i] = leads[i, index]
                v_slope, v_bow = ellipse_gradient(slope, bow, root, rho, v_root, v_compensation, eps2d)
                if finite and not (wp.isfinite(v_slope) and wp.isfinite(v_bow)):
                    v_slope, v_bow = vec6d(), vec6d()
                    v_mean = vec2()
                    v_depth_given = dtype(0.0)
                # f(m) is the mean's own, and what all bows are taken from
                v_center = wp.vec2d(wp.float64(v_mean[0]), wp.float64(v_mean[1]))
                for i in range(3):
                    v_bow[i] = (v_bow[i] + half * wp.float64(v_mean[0])) / (spread * spread)
                    v_bow[3 + i] = (v_bow[3 + i] + half * wp.float64(v_mean[1])) / (spread * spread)
                    v_center -= two * wp.vec2d(v_bow[i], v_bow[3 + i])

                raw_K = Ks[image]
                K = intrinsics(
                    wp.float64(raw_K[0, 0]), wp.float64(raw_K[1, 1]), wp.float64(raw_K[0, 2]), wp.float64(raw_K[1, 2])
                )
                pose, k, limit = pose_of(viewmats, motions, image), lens_of(coefficients, image), limits[image]
                drifting = drift(pose)
                square, time = wp.float64(0.0), wp.float64(0.0)
                if wp.static(rolling):
                    square = pose[33]
                    time = times[index]
                path = turned(pose, m)
                path[0] = path[0] + begin(pose)
                paths = paths_kind()
                for i in range(3):
                    of_axis = turned(pose, axes[i])
                    for r in range(wp.static(rows)):
                        paths[i * rows + r] = of_axis[r]

                g_path, g_paths = path_kind(), paths_kind()
                g_drift, g_square = wp.vec3d(), wp.float64(0.0)
                g_K, g_lens = wp.vec4d(), lens_vector()
                points = int(7)  # in a variable: a loop, and no copies of it
                for point in range(points):  # the mean, above it along the axes, and below
                    axis = wp.max(point - 1, 0) % 3
                    away, tau, v_depth = wp.float64(0.0), time, wp.float64(0.0)
                    v_u = v_center
                    if point == 0:
                        v_depth = wp.float64(v_depth_given)
                    else:
                        away = wp.where(point > 3, -spread, spread)
                        v_u = wp.vec2d(v_bow[axis], v_bow[3 + axis])
                        v_u += (half / away) * wp.vec2d(v_slope[axis], v_slope[3 + axis])
                        if wp.static(rolling):
                            tau = time + wp.float64(lead[point - 1])
                    here = path_kind()
                    for r in range(wp.static(rows)):
                        here[r] = path[r] + away * paths[axis * rows + r]
                    w = weights(square, tau)
                    x = position(here, w, drifting, tau)
                    _seen, bent, J = bend(x, k, limit)
                    J[0] = K[0] * J[0]
                    J[1] = K[1] * J[1]
                    if wp.static(rolling):
                        along = wp.vec2d(shutter[0], shutter[1])
                        rate = velocity(here, w, drifting, square)
                        pace = J * rate
                        v_u += (v_depth * rate[2]) * along
                        v_u += (wp.dot(pace, v_u) / (one - wp.dot(along, pace))) * along
                    v_x = wp.transpose(J) * v_u + wp.vec3d(zero, zero, v_depth)
                    for r in range(wp.static(rows)):
                        weighted = w[r] * v_x
                        g_path[r] = g_path[r] + weighted
                        g_paths[axis * rows + r] = g_paths[axis * rows + r] + away * weighted
                    if wp.static(to_cameras):
                        if wp.static(rolling):
                            s_square, c_square = turn_bends(square, tau)
                            g_drift += tau * v_x
                            g_square += wp.dot(v_x, s_square * here[1] + c_square * here[2])
                        g_K += wp.vec4d(v_u[0] * bent[0], v_u[1] * bent[1], v_u[0], v_u[1])
                        g_lens += coefficient_gradient(x, k, wp.vec2d(K[0] * v_u[0], K[1] * v_u[1]))

                g_mean += turned_back(pose, g_path)
                g_pose = pose_kind()
                if wp.static(to_cameras):
                    g_pose = turn_gradient(g_path, m)
                for i in range(3):
                    of_axis = path_kind()
                    for r in range(wp.static(rows)):
                        of_axis[r] = g_paths[i * rows + r]
                    g_axes[i] = g_axes[i] + turned_back(pose, of_axis)
                    if wp.static(to_cameras):
                        g_pose += turn_gradient(of_axis, axes[i])
                if wp.static(to_cameras):
                    if wp.static(rolling):
                        for i in range(wp.static(MOTION)):
                            G[i] = dtype(g_pose[i])
                        for i in range(3):
                            G[27 + i] = dtype(g_path[0, i])
                            G[30 + i] = dtype(g_drift[i])
                        G[33] = dtype(g_square)
                    else:
                        for i in range(3):
                            for j in range(3):
                                G[4 * i + j] = dtype(g_pose[i, j])
                            G[4 * i + 3] = dtype(g_path[0, i])
                    if wp.static(not in_pixels):
                        G[poses] = dtype(g_K[0])
                        G[poses + 1] = dtype(g_K[1])
                    G[poses + 2] = dtype(g_K[2])
                    G[poses + 3] = dtype(g_K[3])
                    for i in range(wp.static(LENS_COEFFS)):
                        G[poses + 4 + i] = dtype(g_lens[i])
                    # A gradient too large for its type: none at all, rather than an infinity that ends an optimisation.
                    if finite and not wp.isfinite(G):
                        G = record()
            if wp.static(to_cameras):
                store_lane_sum(v_cameras, image * warps + place // lanes, place % lanes, record64(G))

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
        written = wp.where(inside, gaussian, -1)
        store3(v_means, written, own)
        store3(v_scales, written, g_scale)
        if inside:
            store4(v_quats, gaussian, g_quat)

    return affine_camera_adjoint_kernel


def _launch_bounds(dtype: type, rolling: bool) -> tuple[int, int] | None:
    """One block a multiprocessor: two spill a hundred numbers, without a rolling shutter, too."""
    return None
