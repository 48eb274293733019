"""The step that projects Gaussians through lenses and rolling shutters: its launches, and its adjoint.

Every Gaussian gets an affine camera of its own (affine_cameras). For the adjoint its slopes are kept, and with a
rolling shutter the times at which its seven points are seen.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.launching import launch, launch_again
from warp_kernels.machinery.strand_sums import image_sums
from warp_kernels.machinery.tape_recording import gradient_of
from warp_kernels.projection.affine_camera_adjoint import affine_camera_adjoint_kernel
from warp_kernels.projection.affine_cameras import affine_camera_kernel, block_threads
from warp_kernels.projection.camera_gradients import ROLLING_RECORD, STILL_RECORD, WarpRows, lens_finish_kernel
from warp_kernels.projection.lens_limits import lens_limits
from warp_kernels.projection.lens_models import LensModel
from warp_kernels.projection.plain_camera_step import seen_and_stored
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings


@dataclass(frozen=True)
class LensSettings:
    """What all cameras of a call have in common.

    Attributes:
        model: how their lenses bend rays.
        shutter: a, b and c of the time a x + b y + c at which position (x, y) [px] is read, 0 to 1 within the image;
            None: all of an image is taken at once.
    """

    model: LensModel
    shutter: tuple[float, float, float] | None = None


@dataclass
class LensArrays:
    """Lenses and motions, one an image.

    Attributes:
        coefficients: vec [images] of ``LENS_COEFFS`` numbers; see lens_models. Receives a gradient.
        motions: vec [images] of ``MOTION`` numbers; see shutter_motion. None without a rolling shutter, where the view
            matrices are read. Receives a gradient.
        slopes: [12, images · N] [px]: how far a standard deviation along each axis of a Gaussian reaches to the right,
            and how far down, and behind these how far it is bent, likewise (unscented_ellipse). None where there will
            be no adjoint. Output.
        times: float64 [images · N] [readouts], when the mean is seen. None without a rolling shutter, or an adjoint.
            Output.
        leads: [6, images · N] [readouts], how much later the points above it along its axes are seen, and those
            below; None likewise. Output.
        limits: float64 [images], where images fold back; set by ``project_through_lenses``.
    """

    coefficients: wp.array
    motions: wp.array | None = None
    slopes: wp.array | None = None
    times: wp.array | None = None
    leads: wp.array | None = None
    limits: wp.array | None = None


def project_through_lenses(
    gaussians: GaussianArrays,
    lenses: LensArrays,
    lens: LensSettings,
    settings: ProjectionSettings,
    projected: ProjectedArrays,
) -> None:
    """Projects Gaussians as ``plain_camera_step.project_gaussians`` does, through lenses.

    Args:
        lenses: of the images; also takes what the adjoint reads.
        settings: image size, planes and mode; its camera model is not used.
    """
    device, dtype, rolling = gaussians.means.device, gaussians.opacities.dtype, lens.shutter is not None
    lenses.limits = lens_limits(lenses.coefficients, lens.model)
    launch(
        affine_camera_kernel(dtype, lens.model, rolling),
        settings.num_images * settings.num_gaussians,
        [
            *_sights(gaussians, lenses, lens, settings),
            gaussians.opacities,
            gaussians.thermal_opacities,
            *seen_and_stored(settings, projected),
            lenses.slopes,
            lenses.times,
            lenses.leads,
        ],
        device,
        block_threads(dtype, rolling),
    )


def project_through_lenses_adjoint(
    gaussians: GaussianArrays,
    lenses: LensArrays,
    lens: LensSettings,
    settings: ProjectionSettings,
    projected: ProjectedArrays,
    *,
    store: bool = False,
    add_to_means: bool = False,
) -> None:
    """The adjoint of ``project_through_lenses``, as ``project_gaussians_adjoint`` is that of ``project_gaussians``.

    The other arguments are those of ``project_through_lenses``.

    Args:
        lenses: as it left them, with ``slopes``.
        store: gradients of Gaussians are not initialised, and written; else they are added to, as those of cameras are.
        add_to_means: also with ``store``, the means' gradient is added to.
    """
    device, dtype, rolling = gaussians.means.device, gaussians.opacities.dtype, lens.shutter is not None
    inputs = (gaussians.viewmats, gaussians.Ks, lenses.coefficients, lenses.motions)
    to_cameras = any(array is not None and array.grad is not None for array in inputs)
    rows = WarpRows.of(settings.num_gaussians, settings.num_images // max(settings.num_cameras, 1), device)
    record = wp.types.vector(ROLLING_RECORD if rolling else STILL_RECORD, wp.float64)
    v_cameras = empty(settings.num_images * rows.rows, record, device) if to_cameras else None
    launch(
        affine_camera_adjoint_kernel(dtype, lens.model, rolling, to_cameras),
        rows.threads,
        [
            *_sights(gaussians, lenses, lens, settings),
            rows.lanes,
            rows.rows,
            settings.eps2d,
            projected.packed_roots,
            projected.compensations,
            projected.visible,
            lenses.slopes,
            lenses.times,
            lenses.leads,
            projected.means2d.grad,
            projected.depths.grad,
            projected.roots.grad,
            None if projected.compensations is None else projected.compensations.grad,
            store,
            store and not add_to_means,
            gradient_of(gaussians.means),
            gradient_of(gaussians.quats),
            gradient_of(gaussians.scales),
            v_cameras,
        ],
        device,
    )
    if v_cameras is not None:
        launch_again(
            lens_finish_kernel(dtype, rolling),
            settings.num_images,
            [
                image_sums(v_cameras, settings.num_images),
                gradient_of(gaussians.viewmats),
                None if lenses.motions is None else gradient_of(lenses.motions),
                gradient_of(gaussians.Ks),
                gradient_of(lenses.coefficients),
            ],
            device,
        )


def _sights(
    gaussians: GaussianArrays, lenses: LensArrays, lens: LensSettings, settings: ProjectionSettings
) -> list[Any]:
    """What the kernel and its adjoint begin with."""
    return [
        settings.num_gaussians,
        settings.num_cameras,
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.viewmats,
        lenses.motions,
        gaussians.Ks,
        lenses.coefficients,
        lenses.limits,
        *(lens.shutter or (0.0, 0.0, 0.0)),
    ]
