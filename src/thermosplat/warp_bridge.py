"""Torch autograd over Warp tapes: the only file where torch meets warp_kernels (warp_streams.py shares the device).

Each step of the rasterizer is one ``torch.autograd.Function``. Its forward pass wraps torch's memory as Warp arrays,
runs the step and records the adjoint on a ``wp.Tape``; its backward pass lends the gradients to the arrays and replays
the tape. Torch owns every tensor that outlives a call; work runs on torch's current stream.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.errors import UserError
from thermosplat.warp_streams import on_torch_stream
from warp_kernels import binning_step, blending_step, color_step, projection_step
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.tile_binning import TileBins

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Torch dtypes the kernels run in, and Warp's names for them."""


def wrap(tensor: Tensor, dtype: Any) -> wp.array:
    """A Warp array on a torch tensor's memory: ``wp.from_torch`` in half its time, which a render spends 50 times.

    Args:
        tensor: contiguous in the dimensions that the dtype takes.
        dtype: Warp dtype of the tensor's scalars; vectors take the last dimension, matrices the last two.

    Returns:
        The array; it keeps the memory alive.
    """
    tensor = tensor.detach()  # the array must not keep the graph that the tensor is part of
    lead = tensor.dim() - len(getattr(dtype, "_shape_", ()))
    strides = None  # those of a contiguous array, whatever torch says of dimensions of size 1
    if not tensor.is_contiguous():
        strides = tuple(stride * tensor.element_size() for stride in tensor.stride()[:lead])
    array = wp.array(
        ptr=tensor.data_ptr(),
        dtype=dtype,
        shape=tuple(tensor.shape[:lead]),
        strides=strides,
        device=_warp_device(tensor.device),
        copy=False,
    )
    array._tensor = tensor
    return array


@functools.cache
def _warp_device(device: torch.device) -> wp.Device:
    return wp.device_from_torch(device)


def _zeros(tensor: Tensor | None, wanted: bool = True) -> Tensor | None:
    return torch.zeros_like(tensor) if wanted and tensor is not None else None


def _lend(outputs: Sequence[wp.array], gradients: Sequence[Tensor | None]) -> None:
    """Gives outputs the gradients autograd brought; None stands for zeros."""
    for array, gradient in zip(outputs, gradients, strict=True):
        array.grad = wp.zeros_like(array) if gradient is None else wrap(gradient.contiguous(), array.dtype)


def _collect(inputs: Sequence[wp.array | None], gradients: Sequence[Tensor | None]) -> None:
    """Makes the adjoint add to torch's gradients of inputs; None: this one is not wanted."""
    for array, gradient in zip(inputs, gradients, strict=True):
        if array is not None:
            array.grad = None if gradient is None else wrap(gradient, array.dtype)


class ProjectedTensors(NamedTuple):
    """What ``Project`` returns: the fields of ``ProjectedArrays``, a vector's numbers in a last dimension."""

    means2d: Tensor
    depths: Tensor
    roots: Tensor
    compensations: Tensor
    radii: Tensor  # int32, not differentiable
    extents: Tensor  # not differentiable

    def arrays(self) -> ProjectedArrays:
        """The same memory as Warp arrays."""
        scalar = SCALARS[self.means2d.dtype]
        vec2, vec3 = wp.types.vector(2, scalar), wp.types.vector(3, scalar)
        kinds = (vec2, scalar, vec3, scalar, wp.vec2i, vec2)
        return ProjectedArrays(*(wrap(tensor, kind) for tensor, kind in zip(self, kinds, strict=True)))


class Project(torch.autograd.Function):
    """Projection; see ``projection_step``. Returns the fields of ``ProjectedTensors``."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        covars: Tensor | None,
        opacities: Tensor,
        thermal_opacities: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
    ) -> tuple[Tensor, ...]:
        scalar = SCALARS[means.dtype]
        vec3, vec4, vec6 = (wp.types.vector(k, scalar) for k in (3, 4, 6))
        mat33, mat44 = wp.types.matrix((3, 3), scalar), wp.types.matrix((4, 4), scalar)
        entries = len(viewmats) * settings.num_gaussians
        projected = ProjectedTensors(
            means2d=means.new_empty(entries, 2),
            depths=means.new_empty(entries),
            roots=means.new_empty(entries, 3),
            compensations=means.new_empty(entries),
            radii=torch.empty(entries, 2, dtype=torch.int32, device=means.device),
            extents=means.new_empty(entries, 2),
        )
        with on_torch_stream(means.device):
            ctx.gaussians = GaussianArrays(
                wrap(means, vec3),
                wrap(quats, vec4),
                wrap(scales, vec3),
                None if covars is None else wrap(covars, vec6),
                wrap(opacities, scalar),
                wrap(thermal_opacities, scalar),
                wrap(viewmats, mat44),
                wrap(Ks, mat33),
            )
            ctx.projected = projected.arrays()
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            projection_step.project(ctx.gaussians, settings, ctx.projected, ctx.tape)
        ctx.mark_non_differentiable(projected.radii, projected.extents)
        ctx.set_materialize_grads(False)
        # Saved so that torch reports in-place changes between forward and backward.
        outputs = (projected.roots, projected.compensations, projected.radii)
        ctx.save_for_backward(means, quats, scales, covars, viewmats, Ks, *outputs)
        return tuple(projected)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, covars, viewmats, Ks = ctx.saved_tensors[:6]
        to_cameras = ctx.needs_input_grad[6] or ctx.needs_input_grad[7]
        v_means, v_quats, v_scales, v_covars = (_zeros(tensor) for tensor in (means, quats, scales, covars))
        v_viewmats, v_Ks = _zeros(viewmats, to_cameras), _zeros(Ks, to_cameras)
        with on_torch_stream(means.device):
            g, p = ctx.gaussians, ctx.projected
            inputs = (g.means, g.quats, g.scales, g.covars, g.viewmats, g.Ks)
            _collect(inputs, (v_means, v_quats, v_scales, v_covars, v_viewmats, v_Ks))
            _lend((p.means2d, p.depths, p.roots, p.compensations), gradients[:4])
            ctx.tape.backward()
        return v_means, v_quats, v_scales, v_covars, None, None, v_viewmats, v_Ks, None


class ShColors(torch.autograd.Function):
    """Colours from spherical harmonics; see ``color_step``. ``shN`` None: ``sh0`` holds all coefficients."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        camera_positions: Tensor,
        sh0: Tensor,
        shN: Tensor | None,
        radii: Tensor,
        degree: int,
        per_image: bool,
        num_gaussians: int,
        num_cameras: int,
    ) -> Tensor:
        vec3 = wp.types.vector(3, SCALARS[means.dtype])
        colors = means.new_empty(len(radii), 3)
        with on_torch_stream(means.device):
            kinds = (vec3, wp.vec3d, vec3, vec3, vec3)
            tensors = (means, camera_positions, *_by_degree(sh0, shN), colors)
            ctx.arrays = [wrap(tensor, kind) for tensor, kind in zip(tensors, kinds, strict=True)]
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            color_step.sh_colors(
                degree,
                *ctx.arrays[:4],
                wrap(radii, wp.vec2i),
                ctx.arrays[4],
                num_gaussians,
                num_cameras,
                per_image,
                ctx.tape,
            )
        ctx.save_for_backward(means, camera_positions, sh0, shN, radii, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, camera_positions, sh0, shN = ctx.saved_tensors[:4]
        v_means, v_sh0, v_shN = torch.zeros_like(means), torch.zeros_like(sh0), _zeros(shN)
        v_positions = _zeros(camera_positions, ctx.needs_input_grad[1])
        with on_torch_stream(means.device):
            _collect(ctx.arrays[:4], (v_means, v_positions, *_by_degree(v_sh0, v_shN)))
            _lend(ctx.arrays[4:], (v_colors,))
            ctx.tape.backward()
        return v_means, v_positions, v_sh0, v_shN, None, None, None, None, None


def _by_degree(sh0: Tensor, shN: Tensor | None) -> tuple[Tensor, Tensor]:
    """Coefficients of degree 0 and of the others, where they are one tensor as views of it."""
    return (sh0[:, :1], sh0[:, 1:]) if shN is None else (sh0, shN)


@dataclass
class BlendInputs:
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    bins: TileBins
    settings: ProjectionSettings
    thermal_channels: int
    absgrad: bool
    shown_means2d: Tensor
    """The tensor users see as info["means2d"]; its ``absgrad`` attribute is set by the backward pass."""


class Blend(torch.autograd.Function):
    """Blending with one opacity or two; see ``blending_step``."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        roots: Tensor,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        features: Tensor,
        inputs: BlendInputs,
    ) -> tuple[Tensor, ...]:
        scalar = SCALARS[means2d.dtype]
        settings = inputs.settings
        shape = (settings.num_images * settings.height, settings.width)
        images: list[tuple[Tensor, Any]] = []
        for channels in (features.shape[-1], inputs.thermal_channels):
            if channels > 0:
                images += [
                    (means2d.new_empty(*shape, channels), wp.types.vector(channels, scalar)),
                    (means2d.new_empty(shape), scalar),
                    (torch.empty(shape, dtype=torch.int32, device=means2d.device), wp.int32),
                ]
        with on_torch_stream(means2d.device):
            ctx.absolute = torch.zeros_like(means2d) if inputs.absgrad else None
            ctx.projected = inputs.projected
            ctx.opacities = wrap(opacities, scalar)
            ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else wrap(thermal_opacities, scalar)
            ctx.features = wrap(features, wp.types.vector(features.shape[-1], scalar))
            ctx.blended = blending_step.BlendedArrays(*(wrap(image, kind) for image, kind in images))
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            blending_step.blend(
                ctx.projected,
                ctx.opacities,
                ctx.thermal_opacities,
                ctx.features,
                inputs.bins,
                settings,
                ctx.blended,
                ctx.tape,
                absolute=None if ctx.absolute is None else wrap(ctx.absolute, wp.types.vector(2, scalar)),
            )
        ctx.shown_means2d = inputs.shown_means2d
        # Of the images only those that the adjoint reads, so that users may change the renders in place.
        read = [image for image, _ in images if image.dim() == 2]
        ctx.save_for_backward(means2d, roots, opacities, thermal_opacities, features, *read)
        return tuple(image for image, kind in images if kind is not wp.int32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means2d, roots, opacities, thermal_opacities, features = ctx.saved_tensors[:5]
        v_means2d, v_roots, v_opacities, v_features = (_zeros(t) for t in (means2d, roots, opacities, features))
        v_thermal = _zeros(thermal_opacities)
        with on_torch_stream(means2d.device):
            arrays = [ctx.projected.means2d, ctx.projected.roots, ctx.opacities, ctx.features]
            _collect(arrays, (v_means2d, v_roots, v_opacities, v_features))
            if v_thermal is not None:
                _collect([ctx.thermal_opacities], [v_thermal])
            blended = ctx.blended
            images = [blended.render, blended.transmittance, blended.thermal_render, blended.thermal_transmittance]
            _lend(images[: len(gradients)], gradients)
            if ctx.absolute is not None:
                ctx.absolute.zero_()
            ctx.tape.backward()
        if ctx.absolute is not None:
            ctx.shown_means2d.absgrad = ctx.absolute.reshape(ctx.shown_means2d.shape)
        return v_means2d, v_roots, v_opacities, v_thermal, v_features, None


def bin_tiles(
    projected: ProjectedTensors,
    opacities: Tensor,
    thermal_opacities: Tensor,
    features: Tensor,
    settings: ProjectionSettings,
    tile_size: int,
    capacity: int | None = None,
    *,
    deterministic: bool = False,
) -> tuple[ProjectedArrays, TileBins]:
    """Lists the Gaussians of each tile.

    Args:
        projected: from ``Project``; radii of Gaussians with non-finite features become zero, in place.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same tensor where there is one opacity.
        features: [images · N, D].
        settings: image size.
        tile_size: edge of a tile [px].
        capacity: pairs there is room for; None: their number is read back from the device.
        deterministic: number the pairs, so that the adjoint sums in the same order every time; always on the CPU.

    Returns:
        The projected arrays for ``Blend`` and the bins.
    """
    scalar = SCALARS[opacities.dtype]
    with on_torch_stream(opacities.device) as device:
        arrays = projected.arrays()
        try:
            bins = binning_step.bin_tiles(
                arrays,
                wrap(opacities, scalar),
                wrap(thermal_opacities, scalar),
                wrap(features, scalar),
                settings,
                tile_size,
                by_slot=deterministic or not device.is_cuda,
                capacity=capacity,
            )
        except binning_step.TooManyPairsError as error:
            raise UserError(str(error), "Render fewer cameras per call, a smaller image, or smaller scales.") from error
    return arrays, bins


def to_torch(array: wp.array) -> Tensor:
    """A torch tensor on a Warp array's memory, which it keeps alive."""
    return wp.to_torch(array, requires_grad=False)
