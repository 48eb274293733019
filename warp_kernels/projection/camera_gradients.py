"""Gradients to view matrices and intrinsics: the records that the projection's adjoint sums, and what they mean.

An adjoint has one thread a Gaussian. The threads of a scene fill whole warps, so that all lanes of a warp see the same
cameras, and a warp leaves one record an image, the sum over its Gaussians (``WarpRows``).
"""

from dataclasses import dataclass

import warp as wp

from warp_kernels.machinery.lanes import lanes_of
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.lens_models import LENS_COEFFS
from warp_kernels.projection.shutter_motion import MOTION

CAMERA_RECORD = 16
"""Numbers per record of camera gradients: rotation 9 (row-major), translation 3, fx, fy, cx, cy."""

STILL_RECORD = 12 + 4 + LENS_COEFFS
"""Those behind a lens: the first three rows of a view matrix, fx, fy, cx, cy, the coefficients of the lens."""

ROLLING_RECORD = MOTION + 4 + LENS_COEFFS
"""The same with a motion in place of the view matrix."""


@dataclass(frozen=True)
class WarpRows:
    """How threads and rows of camera gradients are numbered.

    Attributes:
        lanes: of a warp; 1 on the CPU.
        rows: warps of a scene, and rows of an image.
        threads: of all scenes.
    """

    lanes: int
    rows: int
    threads: int

    @classmethod
    def of(cls, num_gaussians: int, num_scenes: int, device: wp.Device) -> "WarpRows":
        """Those of scenes of so many Gaussians each.

        Args:
            num_gaussians: N.
        """
        lanes = lanes_of(device)
        rows = -(-num_gaussians // lanes)
        return cls(lanes, rows, num_scenes * rows * lanes)


@made_once
def camera_finish_kernel(dtype: type) -> wp.Kernel:
    """Hands the sum of each image's records to the gradients, one thread per image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.
    """
    record64 = wp.types.vector(CAMERA_RECORD, wp.float64)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)

    @wp.kernel(name=f"finish_camera_gradients_{dtype.__name__}", enable_backward=False, module="unique")
    def finish_camera_gradients_kernel(
        totals: wp.array(dtype=record64),  # [images]
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
        v_Ks: wp.array(dtype=mat33),  # [images]
    ):
        image = wp.tid()
        total = totals[image]
        view = v_viewmats[image]
        for i in range(3):
            for j in range(3):
                view[i, j] = view[i, j] + dtype(total[3 * i + j])
            view[i, 3] = view[i, 3] + dtype(total[9 + i])
        v_viewmats[image] = view
        K = v_Ks[image]
        K[0, 0] = K[0, 0] + dtype(total[12])
        K[1, 1] = K[1, 1] + dtype(total[13])
        K[0, 2] = K[0, 2] + dtype(total[14])
        K[1, 2] = K[1, 2] + dtype(total[15])
        v_Ks[image] = K

    return finish_camera_gradients_kernel


@made_once
def lens_finish_kernel(dtype: type, rolling: bool) -> wp.Kernel:
    """Hands the sum of each image's records to the gradients, one thread an image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.
        rolling: The records begin with motions.
    """
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)
    coefficients_type, motion_type = wp.types.vector(LENS_COEFFS, dtype), wp.types.vector(MOTION, dtype)
    poses = MOTION if rolling else 12
    record64 = wp.types.vector(ROLLING_RECORD if rolling else STILL_RECORD, wp.float64)

    @wp.kernel(
        name=f"finish_lens_gradients{'_rolling' * rolling}_{dtype.__name__}", enable_backward=False, module="unique"
    )
    def finish_lens_gradients_kernel(
        totals: wp.array(dtype=record64),  # [images]
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
        v_motions: wp.array(dtype=motion_type),  # [images]; [0] without a rolling shutter
        v_Ks: wp.array(dtype=mat33),  # [images]
        v_coefficients: wp.array(dtype=coefficients_type),  # [images]
    ):
        image = wp.tid()
        total = totals[image]
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
