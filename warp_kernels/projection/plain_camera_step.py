"""The step that projects Gaussians to cameras without lenses: its launches, and its adjoint on a tape."""

from typing import Any

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.launching import SMALL_BLOCK, launch, launch_again
from warp_kernels.machinery.strand_sums import image_sums
from warp_kernels.machinery.tape_recording import gradient_of, record_adjoint
from warp_kernels.machinery.warp_lists import LISTED, threads_of_many
from warp_kernels.projection.camera_gradients import CAMERA_RECORD, WarpRows, camera_finish_kernel
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings, projection_kernel
from warp_kernels.projection.projection_adjoint import projection_adjoint_kernel


def project_gaussians(
    gaussians: GaussianArrays, settings: ProjectionSettings, projected: ProjectedArrays, tape: wp.Tape | None = None
) -> None:
    """Projects Gaussians to the image plane.

    Args:
        gaussians: inputs. Gradients go to means, quats and scales (or covars), viewmats and Ks where they have one.
        settings: image size, planes and mode.
        projected: outputs, one entry per (image, Gaussian) pair.
        tape: records the adjoint; gradients come from means2d, depths, roots and compensations.
    """
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    launch(
        projection_kernel(dtype, settings.camera_model, gaussians.covars is not None),
        projected.means2d.shape[0],
        [
            settings.num_gaussians,
            settings.num_cameras,
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.covars,
            gaussians.opacities,
            gaussians.thermal_opacities,
            gaussians.viewmats,
            gaussians.Ks,
            *seen_and_stored(settings, projected),
        ],
        device,
        SMALL_BLOCK,
    )
    if tape is None:
        return
    g, p = gaussians, projected
    inputs = [g.means, g.quats, g.scales, g.viewmats, g.Ks, *([g.covars] if g.covars is not None else [])]
    outputs = [p.means2d, p.depths, p.roots, *([] if p.compensations is None else [p.compensations])]
    record_adjoint(tape, lambda: project_gaussians_adjoint(gaussians, settings, projected), *inputs, *outputs)


def seen_and_stored(settings: ProjectionSettings, projected: ProjectedArrays) -> list[Any]:
    """Arguments that all forward kernels share, in their order: what is drawn, and where that is stored."""
    return [
        settings.width,
        settings.height,
        settings.eps2d,
        settings.near_plane,
        settings.far_plane,
        settings.radius_clip,
        settings.antialiased,
        projected.means2d,
        projected.depths,
        projected.packed_roots,
        projected.compensations,
        projected.visible,
        projected.extents,
    ]


def project_gaussians_adjoint(
    gaussians: GaussianArrays,
    settings: ProjectionSettings,
    projected: ProjectedArrays,
    *,
    store: bool = False,
    add_to_means: bool = False,
) -> None:
    """The adjoint of ``project_gaussians``: from its outputs' gradients, those not given being zero, to its inputs'.

    The other arguments are those of ``project_gaussians``.

    Args:
        projected: what ``project_gaussians`` wrote.
        store: gradients of Gaussians are not initialised, and written; else they are added to, as those of cameras are.
        add_to_means: also with ``store``, the means' gradient is added to.
    """
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    to_cameras = gaussians.viewmats.grad is not None or gaussians.Ks.grad is not None
    scenes = settings.num_images // max(settings.num_cameras, 1)
    covars, count = gaussians.covars, gaussians.means.shape[0]
    rows = WarpRows.of(settings.num_gaussians, scenes, device)
    record = wp.types.vector(CAMERA_RECORD, wp.float64)
    v_cameras = empty(settings.num_images * rows.rows, record, device) if to_cameras else None
    variant = (settings.camera_model, covars is not None, to_cameras, settings.antialiased)
    many = count > LISTED and settings.num_cameras == 1 and device.is_cuda and (scenes == 1 or not to_cameras)
    launch(
        projection_adjoint_kernel(dtype, *variant, many),
        threads_of_many(count) if many else rows.threads,
        [
            settings.num_gaussians,
            settings.num_cameras,
            rows.lanes,
            rows.rows,
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            covars,
            gaussians.viewmats,
            gaussians.Ks,
            settings.width,
            settings.height,
            settings.eps2d,
            projected.roots,
            projected.compensations,
            projected.visible,
            projected.means2d.grad,
            projected.depths.grad,
            projected.roots.grad,
            None if projected.compensations is None else projected.compensations.grad,
            store,
            store and not add_to_means,
            gradient_of(gaussians.means),
            gradient_of(gaussians.quats),
            gradient_of(gaussians.scales),
            None if covars is None else gradient_of(covars),
            v_cameras,
        ],
        device,
    )
    if v_cameras is not None:
        launch_again(
            camera_finish_kernel(dtype),
            settings.num_images,
            [
                image_sums(v_cameras, settings.num_images),
                gradient_of(gaussians.viewmats),
                gradient_of(gaussians.Ks),
            ],
            device,
        )
