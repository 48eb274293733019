"""EWA projection of 3D Gaussians to the image plane (Zwicker et al. 2002, as 3DGS and gsplat 1.5.3 apply it).

Notation of this file and of projection_adjoint: mean m, camera-space position p = R m + t, Jacobian J [2, 3] of the
projection at p (plain_cameras), M = J R, rotation-scale G = R(q) diag(s), A = M G with rows a0, a1. The 2D covariance
is A Aᵀ plus the blur eps2d on its diagonal. Its determinant is |a0 x a1|² + eps2d (|a0|² + |a1|²) + eps2d²: a sum of
non-negative terms, so that it does not cancel for needle-shaped Gaussians as xx·yy - xy² does in float32.

The inverse of the 2D covariance, the conic Q, is stored as its triangular root: Q = Uᵀ U with U = [u, u k; 0, v],
u = sqrt(yy / det), k = -xy / yy, v = 1 / sqrt(yy). Of a long needle Q's small eigenvalue is lost when Q is rounded; of
U nothing is. z = U d is the offset d in units of the Gaussian's own standard deviations, and |z|² = dᵀ Q d.

Images are numbered i = scene · cameras + camera; per-image arrays of Gaussians are flat, index i · N + n.
"""

from dataclasses import dataclass

import warp as wp

from warp_kernels.constants import EXTENT_MAX, FOV_MARGIN
from warp_kernels.machinery.flat_index import image_and_row
from warp_kernels.machinery.lanes import lane_functions
from warp_kernels.machinery.launching import SMALL_BLOCK
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.footprints import footprint_functions
from warp_kernels.projection.plain_cameras import CameraModel, plain_camera_functions
from warp_kernels.projection.rotation import rotation_functions


@made_once
def covariance_functions(dtype: type):
    """2D covariance, its determinants and the gradient of the determinant, without cancellation.

    Returns:
        ``(from_rows, from_covariance)``, Warp functions returning (xx, xy, yy, det) before the blur.
    """
    vec3 = wp.types.vector(3, dtype)
    vec6 = wp.types.vector(6, dtype)
    mat33 = wp.types.matrix((3, 3), dtype)

    @wp.func
    def from_rows(a0: vec3, a1: vec3):
        normal = wp.cross(a0, a1)
        return wp.dot(a0, a0), wp.dot(a0, a1), wp.dot(a1, a1), wp.dot(normal, normal)

    @wp.func
    def symmetric(c: vec6):
        """Matrix of the upper triangle xx, xy, xz, yy, yz, zz."""
        return mat33(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5])

    @wp.func
    def from_covariance(m0: vec3, m1: vec3, covariance: mat33):
        xx = wp.dot(m0, covariance * m0)
        xy = wp.dot(m0, covariance * m1)
        yy = wp.dot(m1, covariance * m1)
        return xx, xy, yy, xx * yy - xy * xy

    return from_rows, symmetric, from_covariance


@made_once
def projection_kernel(dtype: type, camera_model: CameraModel, from_covars: bool) -> wp.Kernel:
    """The forward kernel, one thread an (image, Gaussian) pair.

    Args:
        from_covars: 3D covariances are given instead of quaternions and scales.

    Returns:
        The Warp kernel, launched in blocks of ``SMALL_BLOCK``.
    """
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    vec6 = wp.types.vector(6, dtype)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    to_matrix, _ = rotation_functions(dtype)
    camera_position, camera_axes, jacobian, project_mean, _ = plain_camera_functions(dtype, camera_model)
    culled, footprint = footprint_functions(dtype)
    from_rows, symmetric, from_covariance = covariance_functions(dtype)
    zero, half, one, two = dtype(0.0), dtype(0.5), dtype(1.0), dtype(2.0)
    extent_max, margin = dtype(EXTENT_MAX), dtype(FOV_MARGIN)
    rounding = dtype(2.0**-21 if dtype is wp.float32 else 2.0**-50)  # twice that of four products and their sum
    pinhole = camera_model == "pinhole"
    _, _, reciprocal = lane_functions(dtype)

    @wp.func
    def rounded(x: wp.vec3d):
        return vec3(dtype(x[0]), dtype(x[1]), dtype(x[2]))

    @wp.func
    def rough(view: mat44, i: int, mean: vec3, farthest: dtype):
        """Coordinate i of p without float64, by how much it may err, and the sum of the row's absolute values."""
        row = wp.abs(view[i, 0]) + wp.abs(view[i, 1]) + wp.abs(view[i, 2])
        position = view[i, 0] * mean[0] + view[i, 1] * mean[1] + view[i, 2] * mean[2] + view[i, 3]
        return position, rounding * (row * farthest + wp.abs(view[i, 3])), row

    @wp.func
    def outside(
        position: dtype, error: dtype, row: dtype, depth_error: dtype, depth_row: dtype, rz: dtype, largest: dtype,
        focal: dtype, center: dtype, eps2d: dtype, size: int,
    ):  # fmt: skip
        """Whether a Gaussian is certain to miss the image along one of its axes: all of its standard deviations are at
        most ``largest``, and J is evaluated inside of what ``fov_limits`` says. False for what is not a number."""
        ratio = position * rz
        at = focal * ratio + center
        steep = wp.abs(focal)
        slope = steep * row
        if wp.static(pinhole):
            spare = margin * half * dtype(size)
            slope += wp.max(wp.abs(center + spare), wp.abs(dtype(size) - center + spare)) * depth_row
        deviation = slope * rz * largest + wp.sqrt(eps2d)
        error_of_at = steep * rz * (error + wp.abs(ratio) * depth_error) + rounding * wp.abs(at)
        reach = wp.static(dtype(1.01)) * (extent_max * deviation + error_of_at) + two
        return at + reach < zero or at - reach > dtype(size)

    # 32 warps a multiprocessor wait for memory at once; for 40, axes in float64 leave too few registers.
    bounds = (SMALL_BLOCK, 8) if dtype is wp.float32 else None

    @wp.kernel(
        name=f"project_{camera_model}_{'covars' if from_covars else 'quats'}_{dtype.__name__}",
        enable_backward=False,
        module="unique",
        launch_bounds=bounds,
    )
    def project_kernel(
        first: int,
        num_gaussians: int,
        num_cameras: int,
        means: wp.array(dtype=vec3),  # [scenes · N]
        quats: wp.array(dtype=vec4),  # [scenes · N]; [0] with covars
        scales: wp.array(dtype=vec3),  # [scenes · N]; [0] with covars
        covars: wp.array(dtype=vec6),  # [scenes · N]; [0] without
        opacities: wp.array(dtype=dtype),  # [scenes · N]
        thermal_opacities: wp.array(dtype=dtype),  # [scenes · N]
        viewmats: wp.array(dtype=mat44),  # [images]
        Ks: wp.array(dtype=mat33),  # [images]
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
    ):
        index = wp.tid() + first
        image, gaussian = image_and_row(index, num_gaussians, num_cameras)

        culled(index, compensations, visible)
        view = viewmats[image]
        K = Ks[image]
        mean = means[gaussian]
        # Most of many Gaussians are out of view by far, which needs no float64, nor a quaternion.
        farthest = wp.max(wp.max(wp.abs(mean[0]), wp.abs(mean[1])), wp.abs(mean[2]))
        depth, depth_error, depth_row = rough(view, 2, mean, farthest)
        if depth + depth_error < near_plane:
            return
        s = vec3()
        raw = vec4()
        if wp.static(not from_covars):
            s = scales[gaussian]
            largest = wp.max(wp.max(wp.abs(s[0]), wp.abs(s[1])), wp.abs(s[2]))
            rz = one
            sure = bool(wp.static(camera_model != "fisheye"))  # whose Jacobian has other bounds than those of outside
            if wp.static(pinhole):
                sure = depth > wp.static(dtype(1024.0)) * depth_error  # then 1 / depth is, to a thousandth
                rz = reciprocal(depth)
            x, x_error, x_row = rough(view, 0, mean, farthest)
            y, y_error, y_row = rough(view, 1, mean, farthest)
            beside = outside(x, x_error, x_row, depth_error, depth_row, rz, largest, K[0, 0], K[0, 2], eps2d, width)
            above = outside(y, y_error, y_row, depth_error, depth_row, rz, largest, K[1, 1], K[1, 2], eps2d, height)
            if sure and (beside or above):
                return
            raw = quats[gaussian]
        exact = camera_position(view, mean)
        p = rounded(exact)
        # Written so that NaN is culled too. Positions are tested before anything divides by the depth.
        if not (p[2] >= near_plane and p[2] <= far_plane):
            return
        if wp.static(pinhole):
            if p[2] == zero:
                return

        M = jacobian(exact, K, width, height) * camera_axes(view)
        m0, m1 = rounded(M[0]), rounded(M[1])
        mean2d, remainder = project_mean(exact, K)
        xx, xy, yy, det = zero, zero, zero, zero
        if wp.static(from_covars):
            xx, xy, yy, det = from_covariance(m0, m1, symmetric(covars[gaussian]))
        else:
            back = wp.transpose(to_matrix(raw))
            xx, xy, yy, det = from_rows(wp.cw_mul(rounded(back * M[0]), s), wp.cw_mul(rounded(back * M[1]), s))
        footprint(
            index, gaussian, mean2d, remainder, p[2], xx, xy, yy, det, opacities, thermal_opacities,
            width, height, eps2d, radius_clip, antialiased,
            means2d, depths, packed_roots, compensations, visible, extents,
        )  # fmt: skip

    return project_kernel


@dataclass
class GaussianArrays:
    """Gaussians and cameras as the projection reads them; scenes and cameras are flattened (see the module).

    Attributes:
        means: vec3 [scenes · N], world units.
        quats: vec4 [scenes · N], wxyz, any length. Empty when ``covars`` is given.
        scales: vec3 [scenes · N], standard deviations in world units. Empty when ``covars`` is given.
        covars: vec6 [scenes · N], upper triangle xx, xy, xz, yy, yz, zz; None to use quats and scales.
        opacities: [scenes · N] in [0, 1].
        thermal_opacities: [scenes · N] in [0, 1]; the same array as ``opacities`` where there is one opacity.
        viewmats: mat44 [images], world to camera.
        Ks: mat33 [images], pixels.
    """

    means: wp.array
    quats: wp.array
    scales: wp.array
    covars: wp.array | None
    opacities: wp.array
    thermal_opacities: wp.array
    viewmats: wp.array
    Ks: wp.array


@dataclass
class ProjectedArrays:
    """What the projection writes, one entry per (image, Gaussian) pair.

    Attributes:
        means2d: vec2 [images · N], px.
        depths: [images · N], camera z in world units.
        roots: vec3 [images · N], root (u, k, v) of the inverse 2D covariance, 1/px, 1, 1/px (see the module). The first
            three numbers of ``packed_roots``, in the same memory.
        compensations: [images · N], opacity factor of the antialiased mode (1 in the classic one); 0 where culled. May
            be None in the classic mode.
        visible: bool [images · N]; where it is False the Gaussian is culled, and nothing but this and a compensation
            was written.
        extents: vec2 [images · N], px: half the bounding box of the region with alpha >= ALPHA_MIN.
        packed_roots: vec4 [images · N], the roots, and what rounding took from means2d (see packed_roots).
    """

    means2d: wp.array
    depths: wp.array
    roots: wp.array
    compensations: wp.array | None
    visible: wp.array
    extents: wp.array
    packed_roots: wp.array


@dataclass(frozen=True)
class ProjectionSettings:
    """Scalars of the projection, with gsplat's names and meaning."""

    width: int
    height: int
    num_gaussians: int
    num_cameras: int
    num_images: int
    eps2d: float = 0.3
    near_plane: float = 0.01
    far_plane: float = 1e10
    radius_clip: float = 0.0
    antialiased: bool = False
    camera_model: CameraModel = "pinhole"
