"""What density control notes of a step: how far each visible Gaussian's mean wants to move in the image."""

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def density_kernel(dtype: type) -> wp.Kernel:
    """One thread a Gaussian, which walks its cameras.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the gradients.
    """
    vec2 = wp.types.vector(2, dtype)

    @wp.kernel(name=f"note_density_{dtype.__name__}", enable_backward=False, module="unique")
    def note_density_kernel(
        first: int,
        num_cameras: int,
        half_width: dtype,
        half_height: dtype,
        blocked: wp.array(dtype=wp.float32),  # [1]
        gradients: wp.array(dtype=vec2),  # [cameras · N]
        visible: wp.array(dtype=wp.bool),  # [cameras · N]
        # inputs and outputs
        norm_sums: wp.array(dtype=wp.float32),  # [N]
        observations: wp.array(dtype=wp.float32),  # [N]
    ):
        gaussian = wp.tid() + first
        num_gaussians = norm_sums.shape[0]
        if blocked[0] != 0.0:
            return
        total = dtype(0.0)
        seen = wp.float32(0.0)
        for camera in range(num_cameras):
            index = camera * num_gaussians + gaussian
            if visible[index]:
                gradient = gradients[index]
                total += wp.length(vec2(gradient[0] * half_width, gradient[1] * half_height))
                seen += 1.0
        if seen > 0.0:
            norm_sums[gaussian] = norm_sums[gaussian] + wp.float32(total)
            observations[gaussian] = observations[gaussian] + seen

    return note_density_kernel
