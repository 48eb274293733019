"""Gradients to view matrices and intrinsics: the records that the projection's adjoint sums, and what they mean.

An adjoint has one thread a Gaussian. The threads of a scene fill whole warps, so that all lanes of a warp see the same
cameras, and a warp leaves one record an image, the sum over its Gaussians (``WarpRows``).
"""

from dataclasses import dataclass

import warp as wp

from warp_kernels.machinery.lanes import lanes_of
from warp_kernels.machinery.loading import made_once

CAMERA_RECORD = 16
"""Numbers per record of camera gradients: rotation 9 (row-major), translation 3, fx, fy, cx, cy."""


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
            num_scenes: scenes.
            device: where.
        """
        lanes = lanes_of(device)
        rows = -(-num_gaussians // lanes)
        return cls(lanes, rows, num_scenes * rows * lanes)


@made_once
def camera_finish_kernel(dtype: type) -> wp.Kernel:
    """Hands the sum of each image's records to the gradients, one thread per image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.

    Returns:
        The Warp kernel.
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
