"""Where cameras are, which colours depend on through the directions of view, and the adjoint of that."""

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def camera_position_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Where the cameras are, and the adjoint of that; one thread per image.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the view matrices.

    Returns:
        ``(forward, adjoint)``. The adjoint takes the sum of the directions' gradients, whose negative is the
        gradient v to the position p, and adds to that of the view matrix V: with p = V⁻¹ e4 it is -(V⁻ᵀ v) pᵀ.
    """
    mat44 = wp.types.matrix((4, 4), dtype)
    largest = wp.float64(1.0e37)

    @wp.func
    def inverse(view: mat44):
        exact = wp.mat44d()
        for i in range(4):
            for j in range(4):
                exact[i, j] = wp.float64(view[i, j])
        return wp.inverse(exact)

    @wp.kernel(name=f"camera_positions_{dtype.__name__}", enable_backward=False, module="unique")
    def camera_positions_kernel(
        viewmats: wp.array(dtype=mat44),  # [images]
        # outputs
        camera_positions: wp.array(dtype=wp.vec3d),  # [images]
    ):
        image = wp.tid()
        back = inverse(viewmats[image])
        camera_positions[image] = wp.vec3d(back[0, 3], back[1, 3], back[2, 3])

    @wp.kernel(name=f"camera_position_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def camera_position_adjoint_kernel(
        totals: wp.array(dtype=wp.vec3d),  # [images]
        viewmats: wp.array(dtype=mat44),  # [images]
        # outputs
        v_viewmats: wp.array(dtype=mat44),  # [images]
    ):
        image = wp.tid()
        total = totals[image]
        back = inverse(viewmats[image])
        v_view = v_viewmats[image]
        for i in range(4):
            row = back[0, i] * total[0] + back[1, i] * total[1] + back[2, i] * total[2]
            for j in range(4):
                v = row * back[j, 3]
                # Without what overflows where a view matrix has next to no inverse.
                if wp.abs(v) < largest:
                    v_view[i, j] = v_view[i, j] + dtype(v)
        v_viewmats[image] = v_view

    return camera_positions_kernel, camera_position_adjoint_kernel
