"""The step that projects Gaussians to the image plane: its launches, and its adjoint on a tape."""

import warp as wp

from warp_kernels.launching import launch, launch_again
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings, projection_kernel
from warp_kernels.projection_adjoint import CAMERA_RECORD, camera_finish_kernel, projection_adjoint_kernel
from warp_kernels.strand_sums import strand_sums
from warp_kernels.tape_recording import gradient_of, record_adjoint


def project(
    gaussians: GaussianArrays, settings: ProjectionSettings, projected: ProjectedArrays, tape: wp.Tape | None = None
) -> None:
    """Projects Gaussians to the image plane.

    Args:
        gaussians: inputs. Gradients go to means, quats and scales (or covars), viewmats and Ks where they have one.
        settings: image size, planes and mode.
        projected: outputs, one entry an (image, Gaussian) pair.
        tape: records the adjoint; gradients come from means2d, depths, roots and compensations.
    """
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    from_covars = gaussians.covars is not None
    covars = gaussians.covars if from_covars else wp.empty(0, dtype=wp.types.vector(6, dtype), device=device)
    kernel = projection_kernel(dtype, settings.camera_model, from_covars)
    pairs = len(projected.means2d)
    launch(
        kernel,
        pairs,
        [
            settings.num_gaussians,
            settings.num_cameras,
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            covars,
            gaussians.opacities,
            gaussians.thermal_opacities,
            gaussians.viewmats,
            gaussians.Ks,
            settings.width,
            settings.height,
            dtype(settings.eps2d),
            dtype(settings.near_plane),
            dtype(settings.far_plane),
            dtype(settings.radius_clip),
            settings.antialiased,
            projected.means2d,
            projected.depths,
            projected.roots,
            projected.compensations,
            projected.radii,
            projected.extents,
        ],
        device,
    )
    if tape is None:
        return

    def adjoint() -> None:
        to_cameras = gaussians.viewmats.grad is not None or gaussians.Ks.grad is not None
        record = wp.types.vector(CAMERA_RECORD, dtype)
        v_cameras = wp.empty(pairs if to_cameras else 0, dtype=record, device=device)
        launch(
            projection_adjoint_kernel(dtype, settings.camera_model, from_covars, to_cameras),
            len(gaussians.means),
            [
                settings.num_gaussians,
                settings.num_cameras,
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                covars,
                gaussians.viewmats,
                gaussians.Ks,
                settings.width,
                settings.height,
                dtype(settings.eps2d),
                settings.antialiased,
                projected.roots,
                projected.compensations,
                projected.radii,
                gradient_of(projected.means2d),
                gradient_of(projected.depths),
                gradient_of(projected.roots),
                gradient_of(projected.compensations),
                gradient_of(gaussians.means),
                gradient_of(gaussians.quats),
                gradient_of(gaussians.scales),
                gradient_of(covars),
                v_cameras,
            ],
            device,
        )
        if to_cameras:
            launch_again(
                camera_finish_kernel(dtype),
                len(gaussians.viewmats),
                [
                    strand_sums(v_cameras, settings.num_images),
                    gradient_of(gaussians.viewmats),
                    gradient_of(gaussians.Ks),
                ],
                device,
            )

    g, p = gaussians, projected
    inputs = [g.means, g.quats, g.scales, g.viewmats, g.Ks, *([g.covars] if g.covars is not None else [])]
    record_adjoint(tape, adjoint, *inputs, p.means2d, p.depths, p.roots, p.compensations)
