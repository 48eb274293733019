"""Torch autograd over the blending, which has more to keep until its backward pass than the other steps.

As in rasterization_functions, only what is saved keeps memory alive; the arrays that the adjoint reads are of that
memory, wherever it is by then.
"""

from collections.abc import Callable
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


class BlendSaved(NamedTuple):
    """What the adjoint reads: arrays with their tensors when they are saved, the tensors when they come back."""

    means2d: Any
    packed_roots: Any
    opacities: Any
    thermal_opacities: Any
    features: Any
    rest: Any
    extents: Any
    images: list[Any]
    """Of the images only those that are read, so that users may change the renders in place."""
    lists: list[Any]
    states: Any


class BlendGradients(NamedTuple):
    """Gradients to what ``Blend`` takes."""

    means2d: Tensor
    roots: Tensor
    opacities: Tensor
    thermal_opacities: Tensor | None
    features: Tensor
    rest: Tensor | None
    inputs: None = None


class ImagesOfOpacity(NamedTuple):
    """The images that are blended with one opacity: arrays with their tensors [..., C, H, W, channels]."""

    render: tuple[ArrayView, Tensor]
    transmittance: tuple[ArrayView, Tensor]
    last_pairs: tuple[ArrayView, Tensor]
    alphas: tuple[ArrayView, Tensor]


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
        first = _make_images(means2d, settings, channels)
        second = _make_images(means2d, settings, inputs.thermal_channels) if inputs.thermal_channels > 0 else None
        projected, lists = inputs.projected, inputs.lists
        ctx.opacities = view(opacities, scalar)
        ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else view(thermal_opacities, scalar)
        ctx.features = view(features, vector_of(features.shape[-1], dtype))
        ctx.rest = None if rest is None else view(rest, vector_of(rest.shape[-1], dtype))
        images = [*first, *(second or ())]
        ctx.blended = blending_step.BlendedArrays(*[array for array, _ in images])
        ctx.projected, ctx.bins = projected, lists.bins
        ctx.inputs, ctx.turns = (settings, inputs.shown_means2d), inputs.turns
        step = (projected, ctx.opacities, ctx.thermal_opacities, ctx.features, lists.bins, settings, ctx.blended)
        with launches_on_torch_stream(means2d.device):
            ctx.walk = blending_step.blend(*step, rest=ctx.rest)
        ctx.set_materialize_grads(False)
        read = [first.transmittance, first.last_pairs]
        if second is not None:
            read += [second.transmittance, second.last_pairs]
        saved = BlendSaved(
            means2d=(projected.means2d, means2d),
            packed_roots=(projected.packed_roots, inputs.packed_roots),
            opacities=(ctx.opacities, opacities),
            thermal_opacities=(ctx.thermal_opacities, thermal_opacities),
            features=(ctx.features, features),
            rest=(ctx.rest, rest),
            extents=(projected.extents, None if means2d.is_cuda else inputs.extents),  # only a row of pixels asks
            images=read,
            lists=lists.read_by_adjoint(),
            states=(ctx.walk.states, ctx.walk.states.release()),
        )
        keep(ctx, saved)
        render, render_rest = first.render[1], None
        if rest is not None:
            render, render_rest = render[..., : features.shape[-1]], render[..., features.shape[-1] :]
        return BlendedTensors(
            render=render,
            rest=render_rest,
            alphas=first.alphas[1],
            transmittance=first.transmittance[1],
            thermal_render=None if second is None else second.render[1],
            thermal_alphas=None if second is None else second.alphas[1],
        )

    @staticmethod
    @once_differentiable
    @in_turns
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved, v = kept(ctx), BlendedTensors(*gradients)  # type: ignore[arg-type]
        means2d, features, rest = saved.means2d, saved.features, saved.rest
        ctx.projected.roots.place(ctx.projected.packed_roots.ptr)
        settings, shown_means2d = ctx.inputs
        projected = (ctx.projected.means2d, ctx.projected.roots)
        arrays = (*projected, ctx.opacities, ctx.thermal_opacities, ctx.features, ctx.rest)
        # Stored where a thread has a Gaussian and not a rank; many features' gradients are always added to.
        by_slot = ctx.bins.slots is not None
        make = torch.zeros_like if by_slot else torch.empty_like
        form = torch.contiguous_format
        thermal_opacities = saved.thermal_opacities
        found = BlendGradients(
            means2d=make(means2d, memory_format=form),
            roots=make(saved.packed_roots[..., :3], memory_format=form),
            opacities=make(saved.opacities, memory_format=form),
            thermal_opacities=None if thermal_opacities is None else make(thermal_opacities, memory_format=form),
            features=_gradient_of_features(features, make, by_slot),
            rest=None if rest is None else _gradient_of_features(rest, make, by_slot),
        )
        absolute = None if shown_means2d is None else torch.zeros_like(means2d)
        v_alphas = v.alphas
        if v.transmittance is not None:
            v_alphas = -v.transmittance if v_alphas is None else v_alphas - v.transmittance
        blended, dtype = ctx.blended, means2d.dtype
        images = (
            (blended.transmittance, v_alphas),
            (blended.thermal_render, v.thermal_render),
            (blended.thermal_transmittance, v.thermal_alphas),
        )
        kinds = (vector_of(1 if one is None else one.shape[-1], dtype) for one in (features, rest))
        with launches_on_torch_stream(means2d.device) as device:
            for array, gradient in zip(arrays, found[:-1], strict=True):
                if gradient is not None:
                    array.grad = view(gradient, array.dtype)
            for array, given in images:
                lend(array, given)
            v_images = [
                nothing(kind, 2, device) if given is None else given_view(given, kind, *blended.last_pairs.shape)
                for kind, given in zip(kinds, (v.render, v.rest), strict=True)
            ]
            sums = None if absolute is None else view(absolute, kinds_of(dtype).vec2)
            step = (ctx.projected, *arrays[2:5], ctx.bins, settings, blended, ctx.walk)
            v_given = {"v_images": tuple(v_images), "v_alphas": True, "absolute": sums}
            blending_step.blend_adjoint(*step, rest=ctx.rest, **v_given, store=True)
        take_back(*arrays, *(image for image, _ in images))
        if absolute is not None:  # added up as .grad is: a call with many channels blends several times
            earlier = getattr(shown_means2d, "absgrad", None)
            shown_means2d.absgrad = absolute if earlier is None else earlier + absolute
        return found


def _gradient_of_features(features: Tensor, make: Callable[[Tensor], Tensor], by_slot: bool) -> Tensor:
    """Memory for a gradient; that to many features is added to."""
    return torch.zeros_like(features) if features_apart(features.shape[-1], by_slot) else make(features)


def _make_images(means2d: Tensor, settings: ProjectionSettings, channels: int) -> ImagesOfOpacity:
    """Render, transmittance, last pairs and alphas of an opacity, not initialised."""
    scalar = kinds_of(means2d.dtype).scalar
    rows = (settings.num_images * settings.height, settings.width)
    shape = (*means2d.shape[:-2], settings.height, settings.width)
    render = means2d.new_empty((*shape, channels))
    transmittance, alphas = means2d.new_empty((*shape, 1)), means2d.new_empty((*shape, 1))
    last_pairs = means2d.new_empty((*shape, 1), dtype=torch.int32)
    return ImagesOfOpacity(
        render=(view(render, vector_of(channels, means2d.dtype), *rows), render),
        transmittance=(view(transmittance, scalar, *rows), transmittance),
        last_pairs=(view(last_pairs, wp.int32, *rows), last_pairs),
        alphas=(view(alphas, scalar, *rows), alphas),
    )
