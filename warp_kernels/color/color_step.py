"""The step that evaluates spherical harmonics towards each camera: its launches, and its adjoint on a tape."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import warp as wp

from warp_kernels.color.camera_positions import camera_position_kernels
from warp_kernels.color.harmonic_basis import values_for
from warp_kernels.color.spherical_harmonics import ColorVariant, color_adjoint_kernel, color_kernel
from warp_kernels.machinery.array_views import ArrayView, empty
from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import SMALL_BLOCK, launch, launch_again
from warp_kernels.machinery.strand_sums import image_sums
from warp_kernels.machinery.tape_recording import gradient_of, record_adjoint
from warp_kernels.machinery.warp_lists import LISTED, threads_of_many


@dataclass
class ColorArrays:
    """Spherical harmonics of Gaussians and what they are seen from; scenes and cameras are flattened.

    Attributes:
        means: vec3 [scenes · N]. Receives a gradient.
        viewmats: mat44 [images], world to camera. Receives a gradient.
        sh0: vec3 [scenes · N, 1], coefficients of degree 0, or [images · N, 1] for coefficients of their own per image;
            any strides, as ``shN``. Receives a gradient.
        shN: vec3 [scenes · N, K - 1] or [images · N, K - 1], those of the higher degrees; K at least (degree + 1)².
            Receives a gradient.
        visible: bool [images · N] from the projection.
        colors: vec3 [images · N], output.
        camera_positions: vec3d [images], world units, whatever the means are in float64; set by ``sh_colors``.
    """

    means: wp.array
    viewmats: wp.array
    sh0: wp.array
    shN: wp.array
    visible: wp.array
    colors: wp.array
    camera_positions: wp.array | None = None


@dataclass(frozen=True)
class ColorSettings:
    """Scalars of the colours.

    Attributes:
        degree: 0 to 4.
        num_gaussians: N.
        num_cameras: cameras per scene.
        per_image: coefficients are per (image, Gaussian).
        shifted: 0.5 is added to the sum, as 3DGS does.
        clamped: what is below 0 becomes 0, as 3DGS has it; goes with ``shifted``.
    """

    degree: int
    num_gaussians: int
    num_cameras: int
    per_image: bool = False
    shifted: bool = True
    clamped: bool = True

    @cached_property
    def variant(self) -> ColorVariant:
        """Of the kernels."""
        return ColorVariant(values_for(self.degree), self.shifted, self.clamped)


def sh_colors(arrays: ColorArrays, settings: ColorSettings, tape: wp.Tape | None = None) -> None:
    """Evaluates spherical harmonics in each Gaussian's view direction; where it is culled no colour is written.

    Args:
        arrays: inputs, and the output.
        settings: degree and counts.
        tape: records the adjoint.
    """
    a, device, dtype = arrays, arrays.means.device, arrays.means.dtype._wp_scalar_type_
    images, entries = a.viewmats.shape[0], a.colors.shape[0]
    a.camera_positions = empty(images, wp.vec3d, device)
    launch_again(camera_position_kernels(dtype)[0], images, [a.viewmats, a.camera_positions], device)
    joined = _joined(a.sh0, a.shN)
    rows, lowest = (a.shN, 1) if joined is None else (joined, 0)
    inputs = [*_counts(settings), a.means, a.camera_positions, a.sh0, rows, lowest, a.visible]
    many = entries > LISTED and device.is_cuda
    kernel = color_kernel(dtype, many, settings.variant)
    threads, block = (threads_of_many(entries), SMALL_BLOCK) if many else (entries, None)
    launch(kernel, threads, [*inputs, a.colors], device, block)
    if tape is not None:
        differentiable = (a.means, a.viewmats, a.sh0, a.shN, a.colors)
        record_adjoint(tape, lambda: sh_colors_adjoint(arrays, settings), *differentiable)


def sh_colors_adjoint(arrays: ColorArrays, settings: ColorSettings, *, store: bool = False) -> None:
    """The adjoint of ``sh_colors``: from the colours' gradient to the inputs'.

    Args:
        arrays: as ``sh_colors`` left them.
        store: gradients of means and coefficients are not initialised, and written; else they are added to, as those
            of view matrices are.
    """
    a, device, dtype = arrays, arrays.means.device, arrays.means.dtype._wp_scalar_type_
    vec3, images = a.colors.dtype, a.viewmats.shape[0]
    to_cameras = a.viewmats.grad is not None
    v_offsets = empty(a.colors.shape[0], vec3, device) if to_cameras else None
    v_sh0, v_shN = gradient_of(a.sh0), gradient_of(a.shN)
    rows, v_rows = _joined(a.sh0, a.shN), _joined(v_sh0, v_shN)
    lowest = 0
    if rows is None or v_rows is None:
        rows, v_rows, lowest = a.shN, v_shN, 1
    inputs = [*_counts(settings), a.means, a.camera_positions, rows, a.visible, a.colors, gradient_of(a.colors)]
    launch(
        color_adjoint_kernel(dtype, settings.variant),
        whole_warps(a.means.shape[0], device),
        [*inputs, lowest, store, v_sh0, v_rows, gradient_of(a.means), v_offsets],
        device,
    )
    if to_cameras:
        launch_again(
            camera_position_kernels(dtype)[1],
            images,
            [image_sums(v_offsets, images), a.viewmats, a.viewmats.grad],
            device,
        )


def _counts(settings: ColorSettings) -> list[Any]:
    """What the kernel and its adjoint begin with."""
    return [settings.num_gaussians, settings.num_cameras, settings.per_image, settings.degree]


def _joined(sh0: Any, shN: Any) -> ArrayView | None:
    """Rows of all coefficients, where those of degree 0 lie in front of the others; None where they lie apart."""
    first, others = sh0.strides, shN.strides
    if shN.shape[1] == 0 or shN.ptr != sh0.ptr + first[1] or first != others:
        return None
    return ArrayView(sh0.ptr, (sh0.shape[0], 1 + shN.shape[1]), sh0.dtype, sh0.device, strides=others)
