"""Gradients to view matrices and intrinsics: the record the projection's adjoint writes, and what its sums mean."""

import warp as wp

from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.strand_sums import STRANDS

CAMERA_RECORD = 16
"""Numbers per record of camera gradients: rotation 9 (row-major), translation 3, fx, fy, cx, cy."""


@made_once
def camera_finish_kernel(dtype: type) -> wp.Kernel:
    """Adds the strands of each image and hands the result to the gradients, one thread per image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.

    Returns:
        The Warp kernel.
    """
    record64 = wp.types.vector(CAMERA_RECORD, wp.float64)
    mat33, mat44 = wp.types.matrix((3, 3), dtype), wp.types.matrix((4, 4), dtype)

    @wp.kernel(name=f"finish_camera_gradients_{dtype.__name__}", enable_backward=False, module="unique")
    def finish_camera_gradients_kernel(
        partial_sums: wp.array(dtype=record64),  # [images · STRANDS]
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
        v_Ks: wp.array(dtype=mat33),  # [images]
    ):
        image = wp.tid()
        total = record64()
        for strand in range(wp.static(STRANDS)):
            total = total + partial_sums[image * wp.static(STRANDS) + strand]
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
