"""Torch autograd over the steps of warp_kernels.

Each step of the rasterizer is one ``torch.autograd.Function``, whose passes look at torch's memory as Warp arrays and
run the step or its adjoint (the blending's from a ``wp.Tape``). Adjoints store gradients in memory that is not
initialised where they can. Only what a function saves keeps memory alive until its backward pass, after which torch
lets go of it. Work runs on torch's current stream.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.tile_lists import owners, read_by_adjoint, unowned, views
from thermosplat.warp_bridge import kinds_of, lend, vector_of, view, warp_device_of
from thermosplat.warp_streams import kept_apart, on_torch_stream
from warp_kernels import blending_step
from warp_kernels.array_views import ArrayView, nothing
from warp_kernels.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.projection_step import project, project_adjoint
from warp_kernels.tile_binning import TileBins


def _empty(tensor: Tensor | None) -> Tensor | None:
    return torch.empty_like(tensor) if tensor is not None else None


def _zeros(tensor: Tensor | None, wanted: bool = True) -> Tensor | None:
    return torch.zeros_like(tensor) if wanted and tensor is not None else None


class ProjectedTensors(NamedTuple):
    """What ``Project`` returns: ``ProjectedArrays``'s fields [..., C, N], a vector's numbers in a last dimension."""

    means2d: Tensor
    depths: Tensor
    roots: Tensor
    compensations: Tensor  # empty in the classic mode
    radii: Tensor  # int32, not differentiable
    extents: Tensor  # not differentiable

    def arrays(self) -> ProjectedArrays:
        """The same memory as flat Warp arrays, which do not keep it alive."""
        scalar, vec2, vec3 = kinds_of(self.means2d.dtype)[:3]
        return ProjectedArrays(*map(view, self, (vec2, scalar, vec3, scalar, wp.vec2i, vec2)))


class Project(torch.autograd.Function):
    """Projection; see ``projection_step``. Returns the fields of ``ProjectedTensors``, and the means once more.

    What is computed from the means of projected Gaussians should take those: its gradient is then added to by the
    projection's adjoint, instead of a second gradient of that size by torch.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        opacities: Tensor,
        thermal_opacities: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
        images_shape: tuple[int, ...],
    ) -> tuple[Tensor, ...]:
        shape = (*images_shape, settings.num_gaussians)
        projected = ProjectedTensors(
            means2d=means.new_empty((*shape, 2)),
            depths=means.new_empty(shape),
            roots=means.new_empty((*shape, 3)),
            compensations=means.new_empty(shape if settings.antialiased else 0),
            radii=means.new_empty((*shape, 2), dtype=torch.int32),
            extents=means.new_empty((*shape, 2)),
        )
        ctx.settings = settings
        with on_torch_stream(means.device):
            gaussians = _gaussians(means, quats, scales, covars, opacities, thermal_opacities, viewmats, Ks)
            project(gaussians, settings, projected.arrays())
        ctx.mark_non_differentiable(projected.radii, projected.extents)
        ctx.set_materialize_grads(False)
        outputs = (projected.roots, projected.compensations, projected.radii)
        ctx.save_for_backward(means, quats, scales, covars, opacities, viewmats, Ks, *outputs)
        return *projected, means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, covars, opacities, viewmats, Ks, roots, compensations, radii = ctx.saved_tensors
        to_cameras = ctx.needs_input_grad[6] or ctx.needs_input_grad[7]
        *v_projected, given = gradients
        v_means = torch.empty_like(means) if given is None else given.contiguous()
        v_quats, v_scales, v_covars = _empty(quats), _empty(scales), _empty(covars)
        v_viewmats, v_Ks = _zeros(viewmats, to_cameras), _zeros(Ks, to_cameras)
        kinds = kinds_of(means.dtype)
        with on_torch_stream(means.device) as device:
            g = _gaussians(means, quats, scales, covars, opacities, opacities, viewmats, Ks)
            inputs = (g.means, g.quats, g.scales, g.covars, g.viewmats, g.Ks)
            for array, gradient in zip(inputs, (v_means, v_quats, v_scales, v_covars, v_viewmats, v_Ks), strict=True):
                if gradient is not None:
                    array.grad = view(gradient, array.dtype)
            # Of means2d and depths the adjoint reads only the gradients.
            unread = (ArrayView(0, (radii.numel() // 2,), kind, device) for kind in (kinds.vec2, kinds.scalar))
            outputs = (*unread, view(roots, kinds.vec3), view(compensations, kinds.scalar))
            for array, gradient in zip(outputs, v_projected, strict=False):
                lend(array, gradient)
            projected = ProjectedArrays(*outputs, view(radii, wp.vec2i), nothing(kinds.vec2, 1, device))
            project_adjoint(g, ctx.settings, projected, store=True, add_to_means=given is not None)
        return v_means, v_quats, v_scales, v_covars, None, None, v_viewmats, v_Ks, None, None


def _gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    thermal_opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
) -> GaussianArrays:
    kinds, device = kinds_of(means.dtype), warp_device_of(means.device)
    bound = view(opacities, kinds.scalar)
    return GaussianArrays(
        means=view(means, kinds.vec3),
        quats=nothing(kinds.vec4, 1, device) if quats is None else view(quats, kinds.vec4),
        scales=nothing(kinds.vec3, 1, device) if scales is None else view(scales, kinds.vec3),
        covars=None if covars is None else view(covars, kinds.vec6),
        opacities=bound,
        thermal_opacities=bound if thermal_opacities is opacities else view(thermal_opacities, kinds.scalar),
        viewmats=view(viewmats, kinds.mat44),
        Ks=view(Ks, kinds.mat33),
    )


class ShColors(torch.autograd.Function):
    """Colours from spherical harmonics; see ``color_step``. ``shN`` None: ``sh0`` holds all coefficients."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        viewmats: Tensor,
        sh0: Tensor,
        shN: Tensor | None,
        radii: Tensor,
        settings: ColorSettings,
    ) -> Tensor:
        colors = means.new_empty((radii.numel() // 2, 3))
        ctx.settings = settings
        with on_torch_stream(means.device):
            arrays = _color_arrays(means, viewmats, sh0, shN, radii, colors)
            sh_colors(arrays, settings)
        ctx.camera_positions = arrays.camera_positions
        ctx.save_for_backward(means, viewmats, sh0, shN, radii, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, viewmats, sh0, shN, radii, colors = ctx.saved_tensors
        v_means, v_sh0, v_shN = torch.empty_like(means), torch.empty_like(sh0), _empty(shN)
        v_viewmats = _zeros(viewmats, ctx.needs_input_grad[1])
        with on_torch_stream(means.device):
            arrays = _color_arrays(means, viewmats, sh0, shN, radii, colors)
            arrays.camera_positions = ctx.camera_positions
            arrays.means.grad = view(v_means, arrays.means.dtype)
            arrays.sh0.grad, arrays.shN.grad = _by_degree(v_sh0, v_shN)
            if v_viewmats is not None:
                arrays.viewmats.grad = view(v_viewmats, arrays.viewmats.dtype)
            lend(arrays.colors, v_colors)
            sh_colors_adjoint(arrays, ctx.settings, store=True)
        return v_means, v_viewmats, v_sh0, v_shN, None, None


def _color_arrays(
    means: Tensor, viewmats: Tensor, sh0: Tensor, shN: Tensor | None, radii: Tensor, colors: Tensor
) -> ColorArrays:
    kinds = kinds_of(means.dtype)
    coefficients = _by_degree(sh0, shN)
    positions = (view(means, kinds.vec3), view(viewmats, kinds.mat44))
    return ColorArrays(*positions, *coefficients, view(radii, wp.vec2i), view(colors, kinds.vec3))


def _by_degree(sh0: Tensor, shN: Tensor | None) -> tuple[ArrayView, ArrayView]:
    """Coefficients of degree 0 and of the others, where they are one tensor as two views of it."""
    kind, count = kinds_of(sh0.dtype).vec3, sh0.shape[-2]
    rows = sh0.numel() // (3 * count)
    if shN is not None:
        return view(sh0, kind, rows, 1), view(shN, kind, rows, shN.shape[-2])
    vector = 3 * sh0.element_size()
    strides, device = (vector * count, vector), warp_device_of(sh0.device)
    first = ArrayView(sh0.data_ptr(), (rows, 1), kind, device, strides=strides)
    return first, ArrayView(sh0.data_ptr() + vector, (rows, count - 1), kind, device, strides=strides)


@dataclass
class BlendInputs:
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    extents: Tensor
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
        dtype, settings = means2d.dtype, inputs.settings
        scalar, vec2 = kinds_of(dtype)[:2]
        rows = (settings.num_images * settings.height, settings.width)
        shape = (*means2d.shape[:-2], settings.height, settings.width)
        renders, read, arrays = [], [], []
        for channels in (features.shape[-1], inputs.thermal_channels):
            if channels > 0:
                render, transmittance = means2d.new_empty((*shape, channels)), means2d.new_empty((*shape, 1))
                last_pairs = means2d.new_empty(rows, dtype=torch.int32)
                renders += [render, transmittance]
                read += [transmittance, last_pairs]
                kinds = ((render, vector_of(channels, dtype)), (transmittance, scalar), (last_pairs, wp.int32))
                arrays += [view(image, kind, *rows) for image, kind in kinds]
        with on_torch_stream(means2d.device), kept_apart() as made:
            ctx.absolute = torch.zeros_like(means2d) if inputs.absgrad else None
            ctx.projected = inputs.projected
            ctx.opacities = view(opacities, scalar)
            ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else view(thermal_opacities, scalar)
            ctx.features = view(features, vector_of(features.shape[-1], dtype))
            ctx.blended = blending_step.BlendedArrays(*arrays)
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            bins = read_by_adjoint(inputs.bins)
            lists = unowned(bins)
            blending_step.blend(
                ctx.projected,
                ctx.opacities,
                ctx.thermal_opacities,
                ctx.features,
                lists,
                settings,
                ctx.blended,
                ctx.tape,
                absolute=None if ctx.absolute is None else view(ctx.absolute, vec2),
            )
        ctx.shown_means2d = inputs.shown_means2d
        ctx.set_materialize_grads(False)
        # Of the images only those that the adjoint reads, so that users may change the renders in place.
        extents = None if means2d.is_cuda else inputs.extents  # which only a row of pixels asks for
        tensors = (means2d, roots, opacities, thermal_opacities, features, extents)
        ctx.save_for_backward(*tensors, *read, *owners(bins), *(tensor for _, tensor in made))
        projected = (ctx.projected.means2d, ctx.projected.roots)
        gaussians = (*projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.projected.extents)
        images = [array for image in range(0, len(arrays), 3) for array in arrays[image + 1 : image + 3]]
        ctx.arrays = (*gaussians, *images, *views(lists), *(array for array, _ in made))  # of the saved tensors
        return tuple(renders)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        for array, tensor in zip(ctx.arrays, saved, strict=True):
            # What is saved may come back elsewhere: from the host, or recomputed (torch.utils.checkpoint).
            if tensor is not None and tensor.data_ptr() != array.ptr:
                array.place(tensor.data_ptr())
        means2d, roots, opacities, thermal_opacities, features = saved[:5]
        inputs = (means2d, roots, opacities, thermal_opacities, features)
        arrays = (ctx.projected.means2d, ctx.projected.roots, ctx.opacities, ctx.thermal_opacities, ctx.features)
        found = tuple(_zeros(tensor) for tensor in inputs)
        blended = ctx.blended
        images = [blended.render, blended.transmittance, blended.thermal_render, blended.thermal_transmittance]
        with on_torch_stream(means2d.device):
            for array, gradient in zip(arrays, found, strict=True):
                if gradient is not None:
                    array.grad = view(gradient, array.dtype)
            for array, given in zip(images, gradients, strict=False):
                lend(array, given)
            if ctx.absolute is not None:
                ctx.absolute.zero_()
            ctx.tape.backward()
            for image in images[: len(gradients)]:
                image.grad = None
        if ctx.absolute is not None:
            ctx.shown_means2d.absgrad = ctx.absolute
        return *found, None
