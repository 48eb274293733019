"""Torch autograd over the blending, which has more to keep until its backward pass than the other steps.

As in rasterization_functions, only what is saved keeps memory alive; the arrays that the adjoint reads are of that
memory, wherever it is by then.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.tile_lists import owners, read_by_adjoint, unowned, views
from thermosplat.warp_bridge import given_view, kinds_of, lend, vector_of, view
from thermosplat.warp_streams import kept_apart, on_torch_stream
from warp_kernels import blending_step
from warp_kernels.array_views import nothing
from warp_kernels.gradient_records import features_apart
from warp_kernels.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.tile_binning import TileBins


@dataclass
class BlendInputs:
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    extents: Tensor
    bins: TileBins
    settings: ProjectionSettings
    thermal_channels: int
    shown_means2d: Tensor | None
    """The tensor users see as info["means2d"], whose ``absgrad`` attribute the backward pass sets; None: not wanted."""


class BlendedTensors(NamedTuple):
    """What ``Blend`` returns, [..., C, H, W, channels]."""

    render: Tensor
    rest: Tensor | None
    """The other channels, a view as ``render`` is where there are any."""
    alphas: Tensor
    transmittance: Tensor
    """1 - alphas before rounding."""
    thermal_render: Tensor | None
    thermal_alphas: Tensor | None


class Blend(torch.autograd.Function):
    """Blending with one opacity or two; see ``blending_step``. Returns the fields of ``BlendedTensors``."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        roots: Tensor,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        features: Tensor,
        rest: Tensor | None,
        inputs: BlendInputs,
    ) -> BlendedTensors:
        dtype, settings = means2d.dtype, inputs.settings
        scalar = kinds_of(dtype).scalar
        rows = (settings.num_images * settings.height, settings.width)
        shape = (*means2d.shape[:-2], settings.height, settings.width)
        renders: list[Tensor] = []
        read, arrays = [], []
        all_channels = features.shape[-1] + (0 if rest is None else rest.shape[-1])
        for channels in (all_channels, inputs.thermal_channels):
            if channels > 0:
                render, transmittance = means2d.new_empty((*shape, channels)), means2d.new_empty((*shape, 1))
                last_pairs = means2d.new_empty(rows, dtype=torch.int32)
                renders += [render, transmittance]
                read += [transmittance, last_pairs]
                kinds = ((render, vector_of(channels, dtype)), (transmittance, scalar), (last_pairs, wp.int32))
                arrays += [view(image, kind, *rows) for image, kind in kinds]
        with on_torch_stream(means2d.device), kept_apart() as made:
            ctx.projected = inputs.projected
            ctx.opacities = view(opacities, scalar)
            ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else view(thermal_opacities, scalar)
            ctx.features = view(features, vector_of(features.shape[-1], dtype))
            ctx.rest = None if rest is None else view(rest, vector_of(rest.shape[-1], dtype))
            ctx.blended = blending_step.BlendedArrays(*arrays)
            bins = read_by_adjoint(inputs.bins)
            ctx.bins, ctx.inputs = unowned(bins), (settings, inputs.shown_means2d)
            step = (ctx.projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.bins, settings, ctx.blended)
            ctx.walk = blending_step.blend(*step, rest=ctx.rest)
        ctx.set_materialize_grads(False)
        # Of the images only those that the adjoint reads, so that users may change the renders in place.
        extents = None if means2d.is_cuda else inputs.extents  # which only a row of pixels asks for
        tensors = (means2d, roots, opacities, thermal_opacities, features, rest, extents)
        ctx.save_for_backward(*tensors, *read, *owners(bins), *(tensor for _, tensor in made))
        projected = (ctx.projected.means2d, ctx.projected.roots)
        gaussians = (*projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.rest, ctx.projected.extents)
        images = [array for image in range(0, len(arrays), 3) for array in arrays[image + 1 : image + 3]]
        ctx.arrays = (*gaussians, *images, *views(ctx.bins), *(array for array, _ in made))  # of the saved tensors
        render, transmittance = renders[:2]
        render_rest = None
        if rest is not None:
            render, render_rest = render[..., : features.shape[-1]], render[..., features.shape[-1] :]
        thermal_render = renders[2] if len(renders) > 2 else None
        thermal_alphas = 1.0 - renders[3] if len(renders) > 2 else None
        return BlendedTensors(render, render_rest, 1.0 - transmittance, transmittance, thermal_render, thermal_alphas)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        for array, tensor in zip(ctx.arrays, saved, strict=True):
            # What is saved may come back elsewhere: from the host, or recomputed (torch.utils.checkpoint).
            if tensor is not None and tensor.data_ptr() != array.ptr:
                array.place(tensor.data_ptr())
        means2d, (features, rest) = saved[0], saved[4:6]
        settings, shown_means2d = ctx.inputs
        projected = (ctx.projected.means2d, ctx.projected.roots)
        arrays = (*projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.rest)
        # Stored where a thread has a Gaussian and not a rank; many features' gradients are always added to.
        by_slot = ctx.bins.slots is not None
        make = torch.zeros_like if by_slot else torch.empty_like
        found = [None if one is None else make(one) for one in saved[:4]]
        for one in (features, rest):
            added = one is not None and features_apart(one.shape[-1], by_slot)
            found.append(None if one is None else torch.zeros_like(one) if added else make(one))
        absolute = None if shown_means2d is None else torch.zeros_like(means2d)
        v_render, v_rest, v_alphas, v_transmittance, v_thermal_render, v_thermal_alphas = gradients
        if v_transmittance is not None:
            v_alphas = -v_transmittance if v_alphas is None else v_alphas - v_transmittance
        blended, dtype = ctx.blended, means2d.dtype
        images = (
            (blended.transmittance, v_alphas),
            (blended.thermal_render, v_thermal_render),
            (blended.thermal_transmittance, v_thermal_alphas),
        )
        kinds = (vector_of(1 if one is None else one.shape[-1], dtype) for one in (features, rest))
        with on_torch_stream(means2d.device) as device:
            for array, gradient in zip(arrays, found, strict=True):
                if gradient is not None:
                    array.grad = view(gradient, array.dtype)
            for array, given in images:
                lend(array, given)
            v_images = [
                nothing(kind, 2, device) if given is None else given_view(given, kind, *blended.last_pairs.shape)
                for kind, given in zip(kinds, (v_render, v_rest), strict=True)
            ]
            sums = None if absolute is None else view(absolute, kinds_of(dtype).vec2)
            step = (ctx.projected, *arrays[2:5], ctx.bins, settings, blended, ctx.walk)
            v_given = {"v_images": tuple(v_images), "v_alphas": True, "absolute": sums}
            blending_step.blend_adjoint(*step, rest=ctx.rest, **v_given, store=True)
            for image, given in images:
                if given is not None:
                    image.grad = None
        if absolute is not None:
            shown_means2d.absgrad = absolute
        return *found, None
