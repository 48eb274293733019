"""What a lens and a rolling shutter do to every Gaussian, by the unscented transform.

The transform is 3DGUT's, with gsplat's parameters (unscented_ellipse). With f the projection of a point, g1, g2, g3 the
Gaussian's axes times its standard deviations, and δ = α √3,

    mean = f(m) + s,   s = ½ Σ h_i,   h_i = (f(m + δ g_i) + f(m - δ g_i) - 2 f(m)) / δ²,
    covariance = Σ a_i a_iᵀ + ¼ δ² Σ h_i h_iᵀ + (β - α²) s sᵀ,   a_i = (f(m + δ g_i) - f(m - δ g_i)) / (2 δ).

The first sum is the covariance of a sphere of size 1 before an affine camera with a_1, a_2, a_3 as columns: its slopes.
The h_i are its bows: how far the lens bends each axis. That the mean moves by s takes about a quarter off the error of
a linearisation, with lenses and without (benchmarks/bench_lens_projection.py).

With a rolling shutter f(x) = π(V(τ) x), where the time τ = shutter · (f(x), 1) is the one at which the line is read
where the point lands. Newton's method finds it; for the points beside the mean it begins at the time that the mean's
time and its gradient foretell. Beyond the first and the last line the motion goes on: a time that was kept within 0 and
1 would bend f sharply there, which second differences of close points take for a large h_i.
"""

import warp as wp

from warp_kernels.machinery.flat_index import image_and_row
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.footprints import footprint_functions
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel, lens_functions, lens_vector
from warp_kernels.projection.rotation import rotation_functions
from warp_kernels.projection.shutter_motion import MOTION, mat34d, motion_vector, path_rows, pose_functions
from warp_kernels.projection.unscented_ellipse import SPREAD, bows_together, ellipse, vec6d

IMAGE_MARGIN = 0.5
"""A Gaussian whose centre lands farther outside than this share of the image's width or height is not drawn: far off
the axis polynomials are no lens any more. (gsplat allows 0.1.)"""

SHUTTER_STEPS = 10
"""Most steps of Newton's method to the time at which a point is seen; three are usual."""

CONVERGED = {wp.float32: 4.0e-6, wp.float64: 1.0e-8}
"""What the time may be off [readouts] before the last step, which squares it and moves the point along its pace. Left
out is half the square of this times the acceleration in the image, and of the mean a hundred times that: 8e-8 px in
float32 where a point is accelerated by 100 px a readout². A point whose time is not found is not seen."""

EARLIEST, LATEST = -1.0, 2.0
"""Times between which it is looked for: those of centres that are drawn are between -0.5 and 1.5."""

LEAST_PACE = 0.1
"""A point that moves along the lines almost as fast as they are read has many times, or none, and is not drawn."""


@made_once
def sight_functions(dtype: type, model: LensModel, rolling: bool):
    """Where a camera sees a point.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of what is made of it.
        rolling: The pose is a motion, and the time is looked for.

    Returns:
        ``(intrinsics, sight)``, Warp functions in float64.
    """
    bend, _, _ = lens_functions(model)
    _, _, _, weights, position, velocity = pose_functions(rolling)
    path_kind = wp.types.matrix((path_rows(rolling), 3), wp.float64)
    half, one, least, converged = (wp.float64(x) for x in (0.5, 1.0, LEAST_PACE, CONVERGED[dtype]))
    earliest, latest = wp.float64(EARLIEST), wp.float64(LATEST)

    @wp.func
    def intrinsics(fx: wp.float64, fy: wp.float64, cx: wp.float64, cy: wp.float64):
        """Focal lengths and principal point. f-theta has pixels already, counted from the first one's centre."""
        result = wp.vec4d(fx, fy, cx, cy)
        if wp.static(model in ("ftheta", "ftheta_inverse")):
            result = wp.vec4d(one, one, cx + half, cy + half)
        return result

    @wp.func
    def sight(
        path: path_kind,
        drifting: wp.vec3d,
        square: wp.float64,
        K: wp.vec4d,
        k: lens_vector,
        limit: wp.float64,
        shutter: wp.vec3d,
        first_time: wp.float64,
    ):
        """Whether a point is seen, where [px], its position in camera axes, the time, and the gradient of the time in
        that position [readouts per world unit]."""
        u, x, later = wp.vec2d(), wp.vec3d(), wp.vec3d()
        tau = wp.float64(first_time)
        seen = bool(True)
        if wp.static(rolling):
            left = wp.float64(1.0)
            found = bool(False)
            step = int(0)
            while step < wp.static(SHUTTER_STEPS) and seen and not found:
                w = weights(square, tau)
                x = position(path, w, drifting, tau)
                moving = velocity(path, w, drifting, square)
                seen, bent, J = bend(x, k, limit)
                u = wp.vec2d(K[0] * bent[0] + K[2], K[1] * bent[1] + K[3])
                along = wp.vec2d(shutter[0] * K[0], shutter[1] * K[1])
                later = wp.transpose(J) * along
                left = one - wp.dot(later, moving)
                wrong = shutter[0] * u[0] + shutter[1] * u[1] + shutter[2] - tau
                found = wp.abs(wrong) <= converged
                last = tau
                tau = wp.clamp(tau + wrong / wp.max(left, least), earliest, latest)
                if found:
                    x += (tau - last) * moving
                    pace = J * moving
                    u += (tau - last) * wp.vec2d(K[0] * pace[0], K[1] * pace[1])
                step += 1
            seen = seen and found and left > least
            later = (one / left) * later
        else:
            x = path[0]
            seen, bent, _J = bend(x, k, limit)
            u = wp.vec2d(K[0] * bent[0] + K[2], K[1] * bent[1] + K[3])
        return seen, u, x, tau, later

    return intrinsics, sight


@made_once
def loading_functions(dtype: type, rolling: bool):
    """What kernels read of cameras and Gaussians, in float64.

    Args:
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
        rolling: Lines are read out at different times.
    """
    vec2, vec3, vec4, vec6 = (wp.types.vector(k, dtype) for k in (2, 3, 4, 6))
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    rows = path_rows(rolling)
    path_kind, paths_kind = (wp.types.matrix((count, 3), wp.float64) for count in (rows, 3 * rows))
    intrinsics, sight = sight_functions(dtype, model, rolling)
    turned, begin, drift, weights, position, _ = pose_functions(rolling)
    pose_of, lens_of, axes_of = loading_functions(dtype, rolling)
    culled, footprint = footprint_functions(dtype)
    half, one, spread, margin = (wp.float64(x) for x in (0.5, 1.0, SPREAD, 0.5 + IMAGE_MARGIN))

    @wp.func
    def in_reach(u: wp.float64, size: int):
        return wp.abs(u - half * wp.float64(size)) <= margin * wp.float64(size)

    @wp.kernel(
        name=f"affine_cameras_{model}{'_rolling' * rolling}_{dtype.__name__}",
        enable_backward=False,
        module="unique",
        launch_bounds=_launch_bounds(dtype, rolling),
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
        opacities: wp.array(dtype=dtype),  # [scenes · N]
        thermal_opacities: wp.array(dtype=dtype),  # [scenes · N]
        width: int,
        height: int,
        eps2d: dtype,
        near_plane: dtype,
        far_plane: dtype,
        radius_clip: dtype,
        antialiased: bool,
        # outputs
        means2d: wp.array(dtype=vec2),  # [images · N]
        depths: wp.array(dtype=dtype),  # [images · N]
        packed_roots: wp.array(dtype=vec4),  # [images · N]
        compensations: wp.array(dtype=dtype),  # [images · N]; [0]: not wanted
        visible: wp.array(dtype=wp.bool),  # [images · N]
        extents: wp.array(dtype=vec2),  # [images · N]
        slopes: wp.array2d(dtype=dtype),  # [12, images · N], and bows; [0, 0]: not wanted
        times: wp.array(dtype=wp.float64),  # [images · N]; [0] without a rolling shutter, or not wanted
        leads: wp.array2d(dtype=dtype),  # [6, images · N]; likewise
    ):
        index = wp.tid() + first
        image, gaussian = image_and_row(index, num_gaussians, num_cameras)
        culled(index, compensations, visible)
        raw_K = Ks[image]
        K = intrinsics(
            wp.float64(raw_K[0, 0]), wp.float64(raw_K[1, 1]), wp.float64(raw_K[0, 2]), wp.float64(raw_K[1, 2])
        )
        pose, k, limit = pose_of(viewmats, motions, image), lens_of(coefficients, image), limits[image]
        drifting = drift(pose)
        square = wp.float64(0.0)
        if wp.static(rolling):
            square = pose[33]
        shutter = wp.vec3d(shutter_x, shutter_y, shutter_start)
        mean = means[gaussian]
        path = turned(pose, wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2])))
        path[0] = path[0] + begin(pose)
        seen, center, x, tau, later = sight(path, drifting, square, K, k, limit, shutter, half)
        depth = dtype(x[2])
        seen = seen and in_reach(center[0], width) and in_reach(center[1], height)
        if not (seen and depth >= near_plane and depth <= far_plane):
            return
        axes = axes_of(quats[gaussian], scales[gaussian])
        if wp.static(rolling):
            # Read again, at an index that is the same without the compiler seeing it: kept for this, a motion would
            # take 68 registers while the mean's time is looked for.
            pose = pose_of(viewmats, motions, wp.min(image, index))
        paths = paths_kind()
        for i in range(3):
            of_axis = turned(pose, spread * axes[i])
            for r in range(wp.static(rows)):
                paths[i * rows + r] = of_axis[r]
        w = weights(square, tau)
        slope, bow, lead = vec6d(), vec6d(), vec6()
        count = int(3)  # in a variable: a loop, and no copies of it
        for i in range(count):
            away = path_kind()
            for r in range(wp.static(rows)):
                away[r] = paths[i * rows + r]
            sooner = wp.dot(later, position(away, w, wp.vec3d(), tau))
            seen_above, above, _x, tau_above, _later = sight(
                path + away, drifting, square, K, k, limit, shutter, tau + sooner
            )
            seen_below, below, _x, tau_below, _later = sight(
                path - away, drifting, square, K, k, limit, shutter, tau - sooner
            )
            seen = seen and seen_above and seen_below
            bend = (one / (spread * spread)) * ((above - center) + (below - center))
            bow[i] = bend[0]
            bow[3 + i] = bend[1]
            steep = (half / spread) * (above - below)
            slope[i] = steep[0]
            slope[3 + i] = steep[1]
            if wp.static(rolling):
                lead[i] = dtype(tau_above - tau)
                lead[3 + i] = dtype(tau_below - tau)
        if not seen:
            return
        exact = center + bows_together(bow)
        mean2d = vec2(dtype(exact[0]), dtype(exact[1]))
        remainder = vec2(dtype(exact[0] - wp.float64(mean2d[0])), dtype(exact[1] - wp.float64(mean2d[1])))
        xx, xy, yy, det = ellipse(slope, bow)
        footprint(
            index, gaussian, mean2d, remainder, depth,
            dtype(xx), dtype(xy), dtype(yy), dtype(det), opacities, thermal_opacities,
            width, height, eps2d, radius_clip, antialiased,
            means2d, depths, packed_roots, compensations, visible, extents,
        )  # fmt: skip
        if slopes.shape[0] > 0:
            for i in range(6):
                slopes[i, index] = dtype(slope[i])
                slopes[6 + i, index] = dtype(bow[i])
                if wp.static(rolling):
                    leads[i, index] = lead[i]
            if wp.static(rolling):
                times[index] = tau

    return affine_cameras_kernel


def block_threads(dtype: type, rolling: bool) -> int:
    """Threads of a block on CUDA. With a rolling shutter a thread wants 194 registers in float32. Three blocks of 128
    have 168 each, and spill 28 to 48 numbers."""
    return 128 if dtype is wp.float32 and rolling else 256


def _launch_bounds(dtype: type, rolling: bool) -> tuple[int, int] | None:
    """Two blocks of 256 threads a multiprocessor spill next to nothing."""
    return (block_threads(dtype, rolling), 3 if rolling else 2) if dtype is wp.float32 else None
