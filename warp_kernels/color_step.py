"""The step that evaluates spherical harmonics towards each camera: its launches, and its adjoint on a tape."""

import warp as wp

from warp_kernels.coefficient_rows import whole_warps
from warp_kernels.launching import launch, launch_again
from warp_kernels.spherical_harmonics import camera_position_adjoint_kernel, color_adjoint_kernel, color_kernel
from warp_kernels.strand_sums import strand_sums
from warp_kernels.tape_recording import gradient_of, record_adjoint


def sh_colors(
    degree: int,
    means: wp.array,
    camera_positions: wp.array,
    sh0: wp.array,
    shN: wp.array,
    radii: wp.array,
    colors: wp.array,
    num_gaussians: int,
    num_cameras: int,
    per_image: bool = False,
    tape: wp.Tape | None = None,
    *,
    fresh_gradients: bool = False,
) -> None:
    """Evaluates spherical harmonics in each Gaussian's view direction; zero where it is culled.

    Args:
        degree: 0 to 3.
        means: vec3 [scenes · N]. Receives a gradient.
        camera_positions: vec3d [images], world units, float64 whatever the means are. Receives a gradient.
        sh0: vec3 [scenes · N, 1], coefficients of degree 0, or [images · N, 1] for coefficients of their own per image;
            any strides, as ``shN``. Receives a gradient.
        shN: vec3 [scenes · N, K - 1] or [images · N, K - 1], those of the higher degrees; K at least (degree + 1)².
            Receives a gradient.
        radii: vec2i [images · N] from the projection.
        colors: vec3 [images · N], output.
        num_gaussians: N.
        num_cameras: cameras per scene.
        per_image: coefficients are per (image, Gaussian).
        tape: records the adjoint.
        fresh_gradients: the adjoint overwrites the gradients of means and coefficients, which need not be zeros before,
            in place of adding to them.
    """
    device = means.device
    dtype = means.dtype._wp_scalar_type_
    arguments = [num_gaussians, num_cameras, per_image, degree, means, camera_positions, sh0, shN, radii, colors]
    launch(color_kernel(dtype), whole_warps(len(colors), device), arguments, device)
    if tape is None:
        return

    def adjoint() -> None:
        v_offsets = wp.empty_like(colors)
        launch(
            color_adjoint_kernel(dtype),
            whole_warps(len(means), device),
            [*arguments, gradient_of(colors), fresh_gradients, *map(gradient_of, (sh0, shN, means)), v_offsets],
            device,
        )
        if camera_positions.grad is not None:
            launch_again(
                camera_position_adjoint_kernel,
                len(camera_positions),
                [strand_sums(v_offsets, len(camera_positions)), camera_positions.grad],
                device,
            )

    record_adjoint(tape, adjoint, means, camera_positions, sh0, shN, colors)
