"""An affine camera for every Gaussian: what a lens and a rolling shutter do to it, by the unscented transform.

The transform is 3DGUT's (Wu et al., arXiv 2412.12507) with gsplat's α = 0.1 and κ = 0. With f the projection of a
point, g1, g2, g3 the Gaussian's axes times its standard deviations, and δ = α √3,

    mean = f(m) + ½ Σ h_i,   h_i = (f(m + δ g_i) + f(m - δ g_i) - 2 f(m)) / δ²,
    covariance = Σ a_i a_iᵀ,   a_i = (f(m + δ g_i) - f(m - δ g_i)) / (2 δ).

This is the transform's covariance without δ²/4 Σ h_i h_iᵀ + (β - α²) s sᵀ, s = ½ Σ h_i, which changes no error that was
measured. What is left is that of a sphere of size 1 at the origin before the orthographic camera whose view matrix has
a_1, a_2, a_3 as columns of its first two rows: everything after it, and its adjoint, is the orthographic projection's.
That the mean moves by ½ Σ h_i takes about a quarter off the error of a linearisation, with lenses and without
(benchmarks/bench_lens_projection.py).

With a rolling shutter f(x) = π(V(τ) x), where the time τ = shutter · (f(x), 1) is the one at which the line is read
where the point lands. Newton's method finds it. Beyond the first and the last line the motion goes on: a time that was
kept within 0 and 1 would bend f sharply there, which second differences of close points take for a large h_i.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel, lens_functions, lens_vector
from warp_kernels.projection.rotation import rotation_functions
from warp_kernels.projection.shutter_motion import MOTION, mat34d, motion_vector, pose_functions

SPREAD = 0.1 * 3.0**0.5
"""δ: how far the points lie from the mean [standard deviations]. gsplat's α and κ."""

IMAGE_MARGIN = 0.5
"""A Gaussian whose centre lands farther outside than this share of the image's width or height is not drawn: far off
the axis polynomials are no lens any more. (gsplat allows 0.1.)"""

SHUTTER_STEPS = 10
"""Most steps of Newton's method to the time at which a point is seen; three are usual."""

CONVERGED = 1.0e-7
"""What the time may be off [readouts] before the last step, which squares it. A point whose time is not found is not
seen."""

EARLIEST, LATEST = -1.0, 2.0
"""Times between which it is looked for: those of centres that are drawn are between -0.5 and 1.5."""

LEAST_PACE = 0.1
"""A point that moves along the lines almost as fast as they are read has many times, or none, and is not drawn."""


@made_once
def sight_functions(model: LensModel, rolling: bool):
    """Where a camera sees a point.

    Args:
        model: of the lens.
        rolling: The pose is a motion, and the time is looked for.

    Returns:
        ``(intrinsics, sight)``, Warp functions in float64.
    """
    bend, _, _ = lens_functions(model)
    position, velocity, _, _ = pose_functions(rolling)
    pose_kind = motion_vector if rolling else mat34d
    half, one, least, converged = (wp.float64(x) for x in (0.5, 1.0, LEAST_PACE, CONVERGED))
    earliest, latest = wp.float64(EARLIEST), wp.float64(LATEST)

    @wp.func
    def intrinsics(fx: wp.float64, fy: wp.float64, cx: wp.float64, cy: wp.float64):
        """Focal lengths and principal point. f-theta has pixels already, counted from the first one's centre."""
        result = wp.vec4d(fx, fy, cx, cy)
        if wp.static(model in ("ftheta", "ftheta_inverse")):
            result = wp.vec4d(one, one, cx + half, cy + half)
        return result

    @wp.func
    def at_time(pose: pose_kind, m: wp.vec3d, K: wp.vec4d, k: lens_vector, limit: wp.float64, tau: wp.float64):
        x = position(pose, m, tau)
        seen, bent, J = bend(x, k, limit)
        u = wp.vec2d(K[0] * bent[0] + K[2], K[1] * bent[1] + K[3])
        J[0] = K[0] * J[0]
        J[1] = K[1] * J[1]
        return seen, u, J, x

    @wp.func
    def sight(
        pose: pose_kind,
        m: wp.vec3d,
        K: wp.vec4d,
        k: lens_vector,
        limit: wp.float64,
        shutter: wp.vec3d,
        first_time: wp.float64,
    ):
        """Whether a point of the world is seen, where [px], the Jacobian [px per world unit], its position in camera
        axes, the time, its pace in the image [px], and the share of a line that the pace leaves."""
        tau = wp.float64(first_time)
        seen, u, J, x = at_time(pose, m, K, k, limit, tau)
        pace = wp.vec2d()
        left = wp.float64(1.0)
        if wp.static(rolling):
            found = bool(False)
            step = int(0)
            while step < wp.static(SHUTTER_STEPS) and seen and not found:
                pace = J * velocity(pose, m, tau)
                left = one - shutter[0] * pace[0] - shutter[1] * pace[1]
                wrong = shutter[0] * u[0] + shutter[1] * u[1] + shutter[2] - tau
                found = wp.abs(wrong) <= converged
                tau = wp.clamp(tau + wrong / wp.max(left, least), earliest, latest)
                seen, u, J, x = at_time(pose, m, K, k, limit, tau)
                step += 1
            pace = J * velocity(pose, m, tau)
            left = one - shutter[0] * pace[0] - shutter[1] * pace[1]
            seen = seen and found and left > least
        return seen, u, J, x, tau, pace, left

    return intrinsics, sight


@made_once
def loading_functions(dtype: type, rolling: bool):
    """What kernels read of cameras and Gaussians, in float64.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
        rolling: Poses are motions.

    Returns:
        ``(pose_of, lens_of, axes_of)``, Warp functions.
    """
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    mat44 = wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    pose_kind = motion_vector if rolling else mat34d
    to_matrix, _ = rotation_functions(dtype)

    @wp.func
    def pose_of(
        viewmats: wp.array(dtype=mat44),  # [images]
        motions: wp.array(dtype=motion_type),  # [images]; [0] without a rolling shutter
        image: int,
    ):
        pose = pose_kind()
        if wp.static(rolling):
            for i in range(wp.static(MOTION)):
                pose[i] = wp.float64(motions[image][i])
        else:
            view = viewmats[image]
            for i in range(3):
                for j in range(4):
                    pose[i, j] = wp.float64(view[i, j])
        return pose

    @wp.func
    def lens_of(
        coefficients: wp.array(dtype=coefficients_type),  # [images]
        image: int,
    ):
        k = lens_vector()
        for i in range(wp.static(LENS_COEFFS)):
            k[i] = wp.float64(coefficients[image][i])
        return k

    @wp.func
    def axes_of(raw: vec4, s: vec3):
        """Rows: the Gaussian's axes in the world, times its standard deviations."""
        axes = wp.transpose(to_matrix(raw))
        for i in range(3):
            axes[i] = wp.float64(s[i]) * axes[i]
        return axes

    return pose_of, lens_of, axes_of


@made_once
def affine_camera_kernel(dtype: type, model: LensModel, rolling: bool) -> wp.Kernel:
    """The forward kernel, one thread an (image, Gaussian) pair.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
        model: of the lenses.
        rolling: Lines are read out at different times.

    Returns:
        The Warp kernel.
    """
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    intrinsics, sight = sight_functions(model, rolling)
    pose_of, lens_of, axes_of = loading_functions(dtype, rolling)
    zero, one, undefined = dtype(0.0), dtype(1.0), dtype(float("nan"))
    half, spread, margin = wp.float64(0.5), wp.float64(SPREAD), wp.float64(0.5 + IMAGE_MARGIN)

    @wp.func
    def in_reach(u: wp.float64, size: int):
        return wp.abs(u - half * wp.float64(size)) <= margin * wp.float64(size)

    @wp.kernel(
        name=f"affine_cameras_{model}{'_rolling' * rolling}_{dtype.__name__}", enable_backward=False, module="unique"
    )
    def affine_cameras_kernel(
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
        width: int,
        height: int,
        near_plane: dtype,
        far_plane: dtype,
        # outputs
        affine_views: wp.array(dtype=mat44),  # [images · N]; the depth of what is not drawn is not a number
        affine_Ks: wp.array(dtype=mat33),  # [images · N]
    ):
        index = wp.tid() + first
        image = index // num_gaussians
        gaussian = (image // num_cameras) * num_gaussians + index % num_gaussians
        A = mat44()
        A[2, 3] = undefined
        rest = mat33()
        raw_K = Ks[image]
        K = intrinsics(
            wp.float64(raw_K[0, 0]), wp.float64(raw_K[1, 1]), wp.float64(raw_K[0, 2]), wp.float64(raw_K[1, 2])
        )
        pose, k, limit = pose_of(viewmats, motions, image), lens_of(coefficients, image), limits[image]
        shutter = wp.vec3d(shutter_x, shutter_y, shutter_start)
        mean = means[gaussian]
        m = wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]))
        seen, center, _J, x, tau, _pace, _left = sight(pose, m, K, k, limit, shutter, half)
        depth = dtype(x[2])
        seen = seen and in_reach(center[0], width) and in_reach(center[1], height)
        if seen and depth >= near_plane and depth <= far_plane:
            axes = axes_of(quats[gaussian], scales[gaussian])
            mean2d = center
            for i in range(3):
                step = spread * axes[i]
                seen_above, above, _J, _x, _tau, _pace, _left = sight(pose, m + step, K, k, limit, shutter, tau)
                seen_below, below, _J, _x, _tau, _pace, _left = sight(pose, m - step, K, k, limit, shutter, tau)
                seen = seen and seen_above and seen_below
                mean2d += (half / (spread * spread)) * ((above - center) + (below - center))
                slope = (half / spread) * (above - below)
                A[0, i] = dtype(slope[0])
                A[1, i] = dtype(slope[1])
            if seen:
                A[0, 3] = dtype(mean2d[0])
                A[1, 3] = dtype(mean2d[1])
                A[2, 3] = depth
                A[3, 3] = one
                # What rounding took from the position goes where the principal point is.
                rest = mat33(
                    one, zero, dtype(mean2d[0] - wp.float64(A[0, 3])),
                    zero, one, dtype(mean2d[1] - wp.float64(A[1, 3])),
                    zero, zero, one,
                )  # fmt: skip
        affine_views[index] = A
        affine_Ks[index] = rest

    return affine_cameras_kernel
