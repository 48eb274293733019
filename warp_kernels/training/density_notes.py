"""What density control notes of a step: how far each visible Gaussian's mean wants to move in the image."""

import warp as wp

from warp_kernels.machinery.launching import launch
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


def note_density(
    gradients: wp.array,
    visible: wp.array,
    half_size: tuple[float, float],
    blocked: wp.array,
    norm_sums: wp.array,
    observations: wp.array,
) -> None:
    """Adds a step's gradients to the sums.

    Args:
        gradients: vec2 [cameras · N], of the means in the images [1 / px].
        visible: bool [cameras · N]; where a Gaussian counts.
        half_size: what the gradients' components are multiplied with [px].
        blocked: float32 [1]; not 0: add nothing.
        norm_sums: float32 [N], gets the gradients' norms.
        observations: float32 [N], gets the number of cameras that see a Gaussian.
    """
    dtype = gradients.dtype._wp_scalar_type_
    count = len(norm_sums)
    arguments = [len(gradients) // max(count, 1), dtype(half_size[0]), dtype(half_size[1]), blocked]
    launch(density_kernel(dtype), count, [*arguments, gradients, visible, norm_sums, observations], gradients.device)
