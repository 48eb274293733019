"""The step that projects Gaussians through lenses and rolling shutters: its launches, and its adjoint.

Every Gaussian gets an affine camera of its own (affine_cameras), and the orthographic projection does the rest, image
by image. The affine cameras are not kept for the adjoint, which makes them again.
"""

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from warp_kernels.machinery.array_views import ArrayView, empty, nothing
from warp_kernels.machinery.launching import launch, launch_again
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.strand_sums import strand_sums
from warp_kernels.machinery.tape_recording import gradient_of
from warp_kernels.projection.affine_camera_adjoint import (
    ROLLING_RECORD,
    STILL_RECORD,
    affine_camera_adjoint_kernel,
    lens_finish_kernel,
)
from warp_kernels.projection.affine_cameras import affine_camera_kernel
from warp_kernels.projection.camera_gradients import CAMERA_RECORD
from warp_kernels.projection.lens_models import LensModel, lens_limit_kernel
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.projection.projection_step import launch_adjoint, project


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
    """

    coefficients: wp.array
    motions: wp.array | None = None


def project_through_lenses(
    gaussians: GaussianArrays,
    lenses: LensArrays,
    lens: LensSettings,
    settings: ProjectionSettings,
    projected: ProjectedArrays,
) -> None:
    """Projects Gaussians as ``projection_step.project`` does, through lenses.

    Args:
        gaussians: inputs, with quats and scales.
        lenses: of the images.
        lens: what they have in common.
        settings: image size, planes and mode; its camera model is not used.
        projected: outputs, one entry an (image, Gaussian) pair.
    """
    views, Ks = _affine_cameras(gaussians, lenses, lens, settings)
    for image in range(settings.num_images):
        project(*_one_image(gaussians, settings, projected, views, Ks, image))


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
    """The adjoint of ``project_through_lenses``; arguments as ``projection_step.project_adjoint``'s.

    Args:
        gaussians: as in ``project_through_lenses``.
        lenses: likewise.
        lens: likewise.
        settings: likewise.
        projected: what it wrote.
        store: gradients of Gaussians are not initialised, and written; else they are added to, as those of cameras are.
        add_to_means: also with ``store``, the means' gradient is added to.
    """
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    count, rolling = settings.num_gaussians, lens.shutter is not None
    affine = wp.types.vector(CAMERA_RECORD, dtype)
    v_affine = empty(settings.num_images * count, affine, device)
    views, Ks = _affine_cameras(gaussians, lenses, lens, settings)
    spheres = tuple(empty(count, array.dtype, device) for array in (gaussians.means, gaussians.quats, gaussians.scales))
    for image in range(settings.num_images):
        one, settings_of_one, part = _one_image(gaussians, settings, projected, views, Ks, image)
        one.means.grad, one.quats.grad, one.scales.grad = spheres
        launch_adjoint(one, settings_of_one, part, _part(v_affine, image * count, count), store=True)
    inputs = (gaussians.viewmats, gaussians.Ks, lenses.coefficients, lenses.motions)
    to_cameras = any(array is not None and array.grad is not None for array in inputs)
    record = wp.types.vector(ROLLING_RECORD if rolling else STILL_RECORD, dtype)
    v_cameras = empty(len(v_affine), record, device) if to_cameras else nothing(record, 1, device)
    launch(
        affine_camera_adjoint_kernel(dtype, lens.model, rolling, to_cameras),
        len(gaussians.means),
        [
            *_sights(gaussians, lenses, lens, settings),
            projected.radii,
            v_affine,
            store,
            store and not add_to_means,
            gradient_of(gaussians.means),
            gradient_of(gaussians.quats),
            gradient_of(gaussians.scales),
            v_cameras,
        ],
        device,
    )
    if to_cameras:
        launch_again(
            lens_finish_kernel(dtype, rolling),
            settings.num_images,
            [
                strand_sums(v_cameras, settings.num_images),
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
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    limits = empty(settings.num_images, wp.float64, device)
    launch_again(lens_limit_kernel(dtype, lens.model), settings.num_images, [lenses.coefficients, limits], device)
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
        limits,
        *(lens.shutter or (0.0, 0.0, 0.0)),
    ]


def _affine_cameras(
    gaussians: GaussianArrays, lenses: LensArrays, lens: LensSettings, settings: ProjectionSettings
) -> tuple[wp.array, wp.array]:
    """View matrices and intrinsics of all (image, Gaussian) pairs."""
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    pairs = settings.num_images * settings.num_gaussians
    views, Ks = empty(pairs, gaussians.viewmats.dtype, device), empty(pairs, gaussians.Ks.dtype, device)
    launch(
        affine_camera_kernel(dtype, lens.model, lens.shutter is not None),
        pairs,
        [
            *_sights(gaussians, lenses, lens, settings),
            settings.width,
            settings.height,
            settings.near_plane,
            settings.far_plane,
            views,
            Ks,
        ],
        device,
    )
    return views, Ks


def _one_image(
    gaussians: GaussianArrays,
    settings: ProjectionSettings,
    projected: ProjectedArrays,
    views: wp.array,
    Ks: wp.array,
    image: int,
) -> tuple[GaussianArrays, ProjectionSettings, ProjectedArrays]:
    """An image for the orthographic projection: as many scenes as Gaussians, each with a camera and a sphere."""
    device, dtype, count = gaussians.means.device, gaussians.opacities.dtype, settings.num_gaussians
    origin, turn, sphere = _sphere(dtype, device.alias)
    scene, first = image // settings.num_cameras * count, image * count
    spheres = GaussianArrays(
        means=_repeated(origin, count),
        quats=_repeated(turn, count),
        scales=_repeated(sphere, count),
        covars=None,
        opacities=_part(gaussians.opacities, scene, count),
        thermal_opacities=_part(gaussians.thermal_opacities, scene, count),
        viewmats=_part(views, first, count),
        Ks=_part(Ks, first, count),
    )
    settings = replace(settings, num_gaussians=1, num_cameras=1, num_images=count, camera_model="ortho")
    fields = ("means2d", "depths", "roots", "compensations", "radii", "extents", "packed_roots")
    part = {}
    for name in fields:
        array = getattr(projected, name)
        part[name] = array if len(array) == 0 else _part(array, first, count)
        if getattr(array, "grad", None) is not None and len(array) > 0:
            part[name].grad = _part(array.grad, first, count)
    return spheres, settings, ProjectedArrays(**part)


@made_once
def _sphere(dtype: type, device: str) -> tuple[wp.array, wp.array, wp.array]:
    """A sphere of size 1 at the origin: mean, quaternion, scales."""
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    return (
        wp.zeros(1, dtype=vec3, device=device),
        wp.array([vec4(1.0, 0.0, 0.0, 0.0)], dtype=vec4, device=device),
        wp.array([vec3(1.0, 1.0, 1.0)], dtype=vec3, device=device),
    )


def _repeated(array: wp.array, count: int) -> ArrayView:
    """An array whose elements are all the first one of another."""
    return ArrayView(array.ptr, (count,), array.dtype, array.device, array, (0,))


def _part(array: wp.array, first: int, count: int) -> ArrayView:
    """Elements of a flat array."""
    stride = array.strides[0]
    return ArrayView(array.ptr + first * stride, (count,), array.dtype, array.device, array, (stride,))
