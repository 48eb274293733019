"""Adjoint of the EWA projection, written by hand; notation as in projection.

One thread a Gaussian walks the cameras of its scene and sums its own gradient, so that nothing is atomic and the sum
is the same on every run. Gradients to cameras are summed over each warp, and its records afterwards.

With U the conic's root and V the symmetric gradient of the loss to a matrix: the gradient to (u, k, v) determines W,
the sum of p z zᵀ over pixels (see gradient_records), and V_cov = ½ Uᵀ W U, V_A = Uᵀ W (U A). All of it is computed on
whitened rows U B and U M, whose entries are of order 1; of a needle, those of B and M are not, and cancel. For
the antialiasing compensation ρ = sqrt(det / det_blurred) the determinant's gradient is |a0 x a1|² -> 2 a1 x (a0 x a1).

V_A = W A with W symmetric, so that the gradient to a turn of the Gaussian about its axis x, a sum of V_b x b with
V_b = V_A diag(s), is (sy - sz) times a sum of V_Ay bz + V_Az by: of a sphere exactly zero.
"""

import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.lane_sums import lane_sum_function
from warp_kernels.machinery.lanes import LANES_CUDA
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.warp_lists import EACH
from warp_kernels.projection.camera_gradients import CAMERA_RECORD
from warp_kernels.projection.plain_cameras import CameraModel, plain_camera_functions
from warp_kernels.projection.projection import covariance_functions
from warp_kernels.projection.rotation import rotation_functions


@made_once
def projection_adjoint_kernel(
    dtype: type, camera_model: CameraModel, from_covars: bool, to_cameras: bool, antialiased: bool, many: bool = False
) -> wp.Kernel:
    """The adjoint kernel, one thread per Gaussian of a scene, or a warp for each ``warp_lists.MANY``.

    Args:
        from_covars: 3D covariances were given instead of quaternions and scales.
        to_cameras: Also write gradients to view matrices and intrinsics.
        antialiased: The projection's compensations were used.
        many: Most Gaussians may be out of view; on CUDA, of scenes with one camera, and one scene ``to_cameras``.

    Returns:
        The Warp kernel, launched over ``WarpRows.threads``, or with ``many`` over ``threads_of_many``.
    """
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    _, store3, store4 = store_functions(dtype)
    vec6, record = wp.types.vector(6, dtype), wp.types.vector(CAMERA_RECORD, dtype)
    record64, store_lane_sum = wp.types.vector(CAMERA_RECORD, wp.float64), lane_sum_function(CAMERA_RECORD)
    mat23, mat33, mat44 = (wp.types.matrix(shape, dtype) for shape in ((2, 3), (3, 3), (4, 4)))
    to_matrix, turn_adjoint = rotation_functions(dtype)
    camera_position, camera_axes, jacobian, _, position_adjoint = plain_camera_functions(dtype, camera_model)
    from_rows, symmetric, from_covariance = covariance_functions(dtype)
    zero, half, one, two = dtype(0.0), dtype(0.5), dtype(1.0), dtype(2.0)
    suffix = f"{camera_model}_{'covars' if from_covars else 'quats'}{'_cameras' * to_cameras}{'_aa' * antialiased}"
    suffix += "_many" * many
    each, lanes = (EACH, LANES_CUDA) if many else (1, 1)
    # Two blocks a multiprocessor: most Gaussians may be out of view, which only waits for memory.
    bounds = (256, 2) if dtype is wp.float32 else None

    @wp.func
    def mixed(v: vec3, b: vec3):
        """The cross product with plus in place of minus; times differences of scales, the gradient to a small turn."""
        return vec3(v[1] * b[2] + v[2] * b[1], v[2] * b[0] + v[0] * b[2], v[0] * b[1] + v[1] * b[0])

    @wp.kernel(
        name=f"project_adjoint_{suffix}_{dtype.__name__}", enable_backward=False, module="unique", launch_bounds=bounds
    )
    def project_adjoint_kernel(
        first: int,
        num_gaussians: int,
        num_cameras: int,
        lanes_of_row: int,
        rows: int,
        means: wp.array(dtype=vec3),  # [scenes · N]
        quats: wp.array(dtype=vec4),  # [scenes · N]; [0] with covars
        scales: wp.array(dtype=vec3),  # [scenes · N]; [0] with covars
        covars: wp.array(dtype=vec6),  # [scenes · N]; [0] without
        viewmats: wp.array(dtype=mat44),  # [images]
        Ks: wp.array(dtype=mat33),  # [images]
        width: int,
        height: int,
        eps2d: dtype,
        roots: wp.array(dtype=vec3),  # [images · N]
        compensations: wp.array(dtype=dtype),  # [images · N]; [0] in the classic mode
        visible: wp.array(dtype=wp.bool),  # [images · N]
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
        v_covars: wp.array(dtype=vec6),  # [scenes · N]
        v_cameras: wp.array(dtype=record64),  # [images · rows]; [0]: not wanted
    ):
        thread = wp.tid() + first
        nearest = (thread // lanes) * wp.static(each * lanes) + thread % lanes
        seen_bits = int(0)
        if wp.static(many):
            for j in range(each):  # all are asked for before the first is looked at
                if nearest + j * lanes < means.shape[0] and visible[nearest + j * lanes]:
                    seen_bits |= 1 << j
        step = int(0)
        while step < each:
            # A scene's threads are whole warps. Of ``many``, scenes follow one another without a gap.
            spot = nearest + step * lanes
            scene = wp.min(spot, means.shape[0] - 1) // num_gaussians
            place = spot - scene * num_gaussians
            if wp.static(not many):
                scene = spot // (rows * lanes_of_row)
                place = spot % (rows * lanes_of_row)
            inside = place < num_gaussians
            gaussian = scene * num_gaussians + wp.min(place, num_gaussians - 1)
            seen = bool(False)
            if wp.static(many):
                seen = (seen_bits >> step) & 1 > 0
            else:
                for camera in range(num_cameras):
                    if visible[(scene * num_cameras + camera) * num_gaussians + gaussian % num_gaussians]:
                        seen = inside

            # Nothing else is read of a Gaussian that no camera sees.
            mean, v_mean_before, s = vec3(), vec3(), vec3()
            raw = vec4()
            rotation, covariance = mat33(), mat33()
            if seen:
                mean = means[gaussian]
                if not store_means:
                    v_mean_before = v_means[gaussian]
                if wp.static(from_covars):
                    covariance = symmetric(covars[gaussian])
                else:
                    raw = quats[gaussian]
                    s = scales[gaussian]
                    rotation = mat33(to_matrix(raw))
            back = wp.transpose(rotation)

            given = bool(True)
            g_mean = vec3()
            g_scale = vec3()
            g_mixed = vec3()
            g_covar = vec6()
            for camera in range(num_cameras):
                image = scene * num_cameras + camera
                index = image * num_gaussians + gaussian % num_gaussians
                G = record()
                drawn = seen
                if wp.static(not many):
                    drawn = seen and visible[index]
                if drawn:
                    # All that is read of it is asked for before anything is worked out.
                    u = roots[index][0]
                    k = roots[index][1]
                    v = roots[index][2]
                    # gradients that are not given are zero
                    v_xy2, v_depth, v_root, v_compensation = vec2(), zero, vec3(), zero
                    if v_means2d.shape[0] > 0:
                        v_xy2 = v_means2d[index]
                    if v_depths.shape[0] > 0:
                        v_depth = v_depths[index]
                    if v_roots.shape[0] > 0:
                        v_root = v_roots[index]
                    if v_compensations.shape[0] > 0:
                        v_compensation = v_compensations[index]
                    view = viewmats[image]
                    K = Ks[image]
                    exact = camera_position(view, mean)
                    exact_R, exact_J = camera_axes(view), jacobian(exact, K, width, height)
                    R, J, M = mat33(exact_R), mat23(exact_J), mat23(exact_J * exact_R)
                    m0, m1 = M[0], M[1]

                    # root -> W, the moments in whitened coordinates (see gradient_records)
                    finite = wp.isfinite(v_root) and wp.isfinite(v_xy2) and wp.isfinite(v_depth)
                    finite = finite and wp.isfinite(v_compensation)
                    given = given and finite
                    w00 = -u * v_root[0]
                    w01 = -v / u * v_root[1]
                    w11 = -v * v_root[2]

                    # W -> whitened M and the Gaussian's own shape
                    n0 = u * (m0 + k * m1)
                    n1 = v * m1
                    v_n0 = vec3()
                    v_n1 = vec3()
                    if wp.static(from_covars):
                        c0 = covariance * n0
                        c1 = covariance * n1
                        v_n0 = w00 * c0 + w01 * c1
                        v_n1 = w01 * c0 + w11 * c1
                        V = half * (
                            w00 * wp.outer(n0, n0)
                            + w01 * (wp.outer(n0, n1) + wp.outer(n1, n0))
                            + w11 * wp.outer(n1, n1)
                        )
                        g_covar = g_covar + vec6(V[0, 0], two * V[0, 1], two * V[0, 2], V[1, 1], two * V[1, 2], V[2, 2])
                    else:
                        b0 = back * n0
                        b1 = back * n1
                        a0 = wp.cw_mul(b0, s)
                        a1 = wp.cw_mul(b1, s)
                        v_a0 = w00 * a0 + w01 * a1
                        v_a1 = w01 * a0 + w11 * a1
                        g_scale = g_scale + wp.cw_mul(b0, v_a0) + wp.cw_mul(b1, v_a1)
                        v_b0 = wp.cw_mul(v_a0, s)
                        v_b1 = wp.cw_mul(v_a1, s)
                        g_mixed = g_mixed + mixed(v_a0, b0) + mixed(v_a1, b1)
                        v_n0 = rotation * v_b0
                        v_n1 = rotation * v_b1
                    v_m0 = u * v_n0
                    v_m1 = k * v_m0 + v * v_n1

                    # compensation -> determinant and blur
                    if wp.static(antialiased):
                        rho = compensations[index]
                        if rho > zero:
                            xx, xy, yy, det = zero, zero, zero, zero
                            if wp.static(from_covars):
                                xx, xy, yy, det = from_covariance(m0, m1, covariance)
                            else:
                                xx, xy, yy, det = from_rows(wp.cw_mul(back * m0, s), wp.cw_mul(back * m1, s))
                            det_blurred = det + eps2d * (xx + yy) + eps2d * eps2d
                            share = half * v_compensation / (rho * det_blurred)
                            v_det = share * (one - rho * rho)
                            v_blur = -share * rho * rho * eps2d
                            if wp.static(from_covars):
                                c0 = covariance * m0
                                c1 = covariance * m1
                                v_xx = v_blur + v_det * yy
                                v_yy = v_blur + v_det * xx
                                v_xy = -v_det * xy
                                v_m0 = v_m0 + two * (v_xx * c0 + v_xy * c1)
                                v_m1 = v_m1 + two * (v_xy * c0 + v_yy * c1)
                                V = (
                                    v_xx * wp.outer(m0, m0)
                                    + v_xy * (wp.outer(m0, m1) + wp.outer(m1, m0))
                                    + v_yy * wp.outer(m1, m1)
                                )
                                g_covar = g_covar + vec6(
                                    V[0, 0], two * V[0, 1], two * V[0, 2], V[1, 1], two * V[1, 2], V[2, 2]
                                )
                            else:
                                b0 = back * m0
                                b1 = back * m1
                                a0 = wp.cw_mul(b0, s)
                                a1 = wp.cw_mul(b1, s)
                                normal = wp.cross(a0, a1)
                                v_a0 = two * (v_blur * a0 + v_det * wp.cross(a1, normal))
                                v_a1 = two * (v_blur * a1 + v_det * wp.cross(normal, a0))
                                g_scale = g_scale + wp.cw_mul(b0, v_a0) + wp.cw_mul(b1, v_a1)
                                v_b0 = wp.cw_mul(v_a0, s)
                                v_b1 = wp.cw_mul(v_a1, s)
                                g_mixed = g_mixed + mixed(v_a0, b0) + mixed(v_a1, b1)
                                v_m0 = v_m0 + rotation * v_b0
                                v_m1 = v_m1 + rotation * v_b1

                    # M = J R -> J and R
                    v_M = mat23(v_m0[0], v_m0[1], v_m0[2], v_m1[0], v_m1[1], v_m1[2])
                    v_J = v_M * wp.transpose(R)
                    v_R = wp.transpose(J) * v_M

                    # image position and Jacobian -> camera-space position
                    v_p, v_K = position_adjoint(exact, K, J, v_xy2, v_J, width, height)
                    v_p = v_p + vec3(zero, zero, v_depth)

                    g_mean = g_mean + wp.transpose(R) * v_p
                    if wp.static(to_cameras):
                        v_R = v_R + wp.outer(v_p, mean)
                        G = record(
                            v_R[0, 0], v_R[0, 1], v_R[0, 2],
                            v_R[1, 0], v_R[1, 1], v_R[1, 2],
                            v_R[2, 0], v_R[2, 1], v_R[2, 2],
                            v_p[0], v_p[1], v_p[2],
                            v_K[0], v_K[1], v_K[2], v_K[3],
                        )  # fmt: skip
                        if finite and not wp.isfinite(G):
                            G = record()
                if wp.static(to_cameras):
                    row = place // lanes_of_row
                    if row < rows:  # the same for all of a warp
                        store_lane_sum(v_cameras, image * rows + row, place % lanes_of_row, record64(G))

            g_quat = vec4()
            if wp.static(not from_covars):
                if seen:
                    g_quat = turn_adjoint(raw, wp.cw_mul(vec3(s[1] - s[2], s[2] - s[0], s[0] - s[1]), g_mixed))
            held = wp.isfinite(g_mean) and wp.isfinite(g_scale) and wp.isfinite(g_quat) and wp.isfinite(g_covar)
            # A gradient too large for its type: none at all, rather than an infinity that ends an optimisation.
            seen = seen and (held or not given)
            if not seen:
                g_mean, g_quat, g_scale, g_covar = vec3(), vec4(), vec3(), vec6()
            written = wp.where(inside and (seen or store), gaussian, -1)
            if seen and not store:
                if wp.static(from_covars):
                    g_covar = v_covars[gaussian] + g_covar
                else:
                    g_scale = v_scales[gaussian] + g_scale
                    g_quat = v_quats[gaussian] + g_quat
            store3(v_means, wp.where(inside and (seen or store_means), gaussian, -1), v_mean_before + g_mean)
            if wp.static(from_covars):
                if written >= 0:
                    v_covars[gaussian] = g_covar
            else:
                store3(v_scales, written, g_scale)
                if written >= 0:
                    store4(v_quats, gaussian, g_quat)
            step += 1

    return project_adjoint_kernel
