"""Torch autograd over the blending, which has more to keep until its backward pass than the other steps.

As in rasterization_functions, only what is saved keeps memory alive; the arrays that the adjoint reads are of that
memory, wherever it is by then.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.rasterizer.binning import TileLists
from thermosplat.torch_bridge.arrays import given_view, in_turns, keep, kept, kinds_of, lend, take_back, vector_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.blending import blending_step
from warp_kernels.blending.gradient_records import features_apart
from warp_kernels.machinery.array_views import ArrayView, nothing
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings


@dataclass
class BlendInputs:
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    extents: Tensor
    packed_roots: Tensor
    """Whose memory the roots are in: where their numbers are read, while their gradient goes to the tensor of roots."""
    lists: TileLists
    settings: ProjectionSettings
    thermal_channels: int
    shown_means2d: Tensor | None
    """The tensor users see as info["means2d"], whose ``absgrad`` the backward pass adds to; None: not wanted."""
    turns: AbstractContextManager[Any]
    """The scene's lock; see ``in_turns``."""


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
        channels = features.shape[-1] + (0 if rest is None else rest.shape[-1])
        images = _make_images(means2d, settings, (channels, inputs.thermal_channels))
        projected, lists = inputs.projected, inputs.lists
        ctx.opacities = view(opacities, scalar)
        ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else view(thermal_opacities, scalar)
        ctx.features = view(features, vector_of(features.shape[-1], dtype))
        ctx.rest = None if rest is None else view(rest, vector_of(rest.shape[-1], dtype))
        ctx.blended = blending_step.BlendedArrays(*[array for array, _ in images])
        ctx.projected, ctx.bins = projected, lists.bins
        ctx.inputs, ctx.turns = (settings, inputs.shown_means2d), inputs.turns
        step = (projected, ctx.opacities, ctx.thermal_opacities, ctx.features, lists.bins, settings, ctx.blended)
        with launches_on_torch_stream(means2d.device):
            ctx.walk = blending_step.blend(*step, rest=ctx.rest)
        ctx.set_materialize_grads(False)
        keep(
            ctx,
            (projected.means2d, means2d),
            (projected.packed_roots, inputs.packed_roots),
            (ctx.opacities, opacities),
            (ctx.thermal_opacities, thermal_opacities),
            (ctx.features, features),
            (ctx.rest, rest),
            (projected.extents, None if means2d.is_cuda else inputs.extents),  # which only a row of pixels asks for
            # Of the images only those that the adjoint reads, so that users may change the renders in place.
            *images[1:3],
            *images[5:7],
            *lists.read_by_adjoint(),
            (ctx.walk.states, ctx.walk.states.release()),
        )
        render, transmittance, _, alphas = (image for _, image in images[:4])
        render_rest = thermal_render = thermal_alphas = None
        if rest is not None:
            render, render_rest = render[..., : features.shape[-1]], render[..., features.shape[-1] :]
        if len(images) > 4:
            thermal_render, thermal_alphas = images[4][1], images[7][1]
        return BlendedTensors(render, render_rest, alphas, transmittance, thermal_render, thermal_alphas)

    @staticmethod
    @once_differentiable
    @in_turns
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        held = kept(ctx)
        means2d, packed_roots, *opacities = held[:4]
        features, rest = held[4:6]
        ctx.projected.roots.place(ctx.projected.packed_roots.ptr)
        settings, shown_means2d = ctx.inputs
        projected = (ctx.projected.means2d, ctx.projected.roots)
        arrays = (*projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.rest)
        # Stored where a thread has a Gaussian and not a rank; many features' gradients are always added to.
        by_slot = ctx.bins.slots is not None
        make = torch.zeros_like if by_slot else torch.empty_like
        shapes = (means2d, packed_roots[..., :3], *opacities)
        found = [None if one is None else make(one, memory_format=torch.contiguous_format) for one in shapes]
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
        with launches_on_torch_stream(means2d.device) as device:
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
        take_back(*arrays, *(image for image, _ in images))
        if absolute is not None:  # added up as .grad is: a call with many channels blends several times
            earlier = getattr(shown_means2d, "absgrad", None)
            shown_means2d.absgrad = absolute if earlier is None else earlier + absolute
        return *found, None


def _make_images(
    means2d: Tensor, settings: ProjectionSettings, channels: tuple[int, int]
) -> list[tuple[ArrayView, Tensor]]:
    """For each opacity with channels a render, transmittance, last pairs and alphas, [..., C, H, W, channels]."""
    scalar = kinds_of(means2d.dtype).scalar
    rows = (settings.num_images * settings.height, settings.width)
    shape = (*means2d.shape[:-2], settings.height, settings.width)
    images = []
    for count in channels:
        if count > 0:
            single = (*shape, 1)
            images += [
                (means2d.new_empty((*shape, count)), vector_of(count, means2d.dtype)),
                (means2d.new_empty(single), scalar),
                (means2d.new_empty(single, dtype=torch.int32), wp.int32),
                (means2d.new_empty(single), scalar),
            ]
    return [(view(image, kind, *rows), image) for image, kind in images]
