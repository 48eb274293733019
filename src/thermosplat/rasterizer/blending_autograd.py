"""Torch autograd over the blending, which has more to keep until its backward pass than the other steps.

As in ``projection_autograd``, only what is saved keeps memory alive; the arrays that the adjoint reads are of that
memory, wherever it is by then.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import (
    given_view,
    kept,
    lend,
    once_in_turns,
    take_back,
    vector_of,
    view,
)
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.blending import blending_step
from warp_kernels.blending.blended_arrays import BlendedArrays, BlendLauncher
from warp_kernels.blending.gradient_records import features_apart, sums_apart
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings

_launcher: ContextVar[BlendLauncher | None] = ContextVar("launcher of blends", default=None)


@contextmanager
def blends_launched_by(launcher: BlendLauncher) -> Iterator[None]:
    """Gives the launches on images of every blending that this thread begins to somebody, backward passes too.

    Args:
        launcher: Makes them, or keeps them.
    """
    outer = _launcher.set(launcher)
    try:
        yield
    finally:
        _launcher.reset(outer)


_READ = ("gaussian_ids", "tile_offsets")
_READ_BY_SLOT = (*_READ, "slots", "order", "pair_ends")


class TileLists(NamedTuple):
    """The lists of Gaussians in tiles, and the memory they lie in."""

    bins: TileBins
    """Arrays that do not keep their memory alive, so that whoever saves the tensors decides how long it lives."""
    tensors: dict[str, Tensor]
    """By the name of the array in it."""

    def read_by_adjoint(self, *, counts: bool) -> tuple[list[Any], list[Tensor]]:
        """Arrays that the blending's adjoint reads, and the tensors they lie in.

        Args:
            counts: the tiles of each Gaussian are among them.
        """
        bins, tensors = self
        names = _READ if bins.slots is None else _READ_BY_SLOT
        if counts:
            names = (*names, "tiles_per_gaussian")
        if bins.masks.shape[0] > 0:
            names = (*names, "masks")
        return [getattr(bins, name) for name in names], [tensors[name] for name in names]


class BlendInputs(NamedTuple):
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    extents: Tensor
    packed_roots: Tensor
    """Whose memory the roots are in: where their numbers are read, while their gradient goes to the tensor of roots."""
    opacities: ArrayView
    thermal_opacities: ArrayView
    """The same array where there is one opacity."""
    lists: TileLists
    settings: ProjectionSettings
    images_shape: tuple[int, ...]
    thermal_channels: int
    shown_means2d: Tensor | None
    """The tensor users see as info["means2d"], whose ``absgrad`` the backward pass adds to; None: not wanted."""
    turns: AbstractContextManager[Any]
    """The scene's lock; see ``once_in_turns``."""


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
    """What gradients are of, as tensors or as the arrays of their memory."""

    means2d: Any
    packed_roots: Any
    opacities: Any
    thermal_opacities: Any
    features: Any
    rest: Any


class ImageTensors(NamedTuple):
    """The images that are blended with one opacity, [..., C, H, W, channels]."""

    render: Tensor
    transmittance: Tensor
    ends: Tensor
    alphas: Tensor


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
    ) -> tuple[Tensor | None, ...]:
        dtype, settings, projected, lists = means2d.dtype, inputs.settings, inputs.projected, inputs.lists
        rows, device = inputs.opacities.shape, inputs.opacities.device
        channels, others = features.shape[-1], 0 if rest is None else rest.shape[-1]
        first, arrays_of_first = _make_images(means2d, inputs, channels + others)
        second: ImageTensors | None = None
        blended = BlendedArrays(*arrays_of_first)
        if inputs.thermal_channels > 0:
            second, arrays_of_second = _make_images(means2d, inputs, inputs.thermal_channels)
            blended = BlendedArrays(*arrays_of_first, *arrays_of_second)
        arrays = BlendSaved(
            projected.means2d,
            projected.packed_roots,
            inputs.opacities,
            inputs.thermal_opacities,
            ArrayView(features.data_ptr(), rows, vector_of(channels, dtype), device),
            None if rest is None else ArrayView(rest.data_ptr(), rows, vector_of(others, dtype), device),
        )
        step = (projected, *arrays[2:5], lists.bins, settings, blended)
        launcher = _launcher.get()
        with launches_on_torch_stream(means2d.device):
            walk = blending_step.blend(*step, rest=arrays.rest, launcher=launcher)
        if ctx is not None and True in ctx.needs_input_grad:
            ctx.set_materialize_grads(False)
            ctx.projected, ctx.read, ctx.bins, ctx.blended, ctx.walk = projected, arrays, lists.bins, blended, walk
            ctx.settings, ctx.shown_means2d, ctx.turns = settings, inputs.shown_means2d, inputs.turns
            ctx.launcher = launcher
            tensors = (means2d, inputs.packed_roots, opacities, thermal_opacities, features, rest)  # as BlendSaved
            # Of the images only those that are read, so that users may change the renders in place. With the alphas
            # that the caller has, nobody has to keep the transmittances.
            read = [blended.alphas, blended.ends]
            memory: list[Any] = [first.alphas, first.ends]
            if walk.states is not None:
                read += [walk.cuts, walk.states]
                memory += [walk.cuts.release(), walk.states.release()]
            if second is not None:
                read += [blended.thermal_alphas, blended.thermal_ends]
                memory += [second.alphas, second.ends]
            if not means2d.is_cuda:  # only a row of pixels asks for them
                read.append(projected.extents)
                memory.append(inputs.extents)
            of_lists, memory_of_lists = lists.read_by_adjoint(counts=not _sums_apart(ctx))
            ctx.arrays = (*arrays, *read, *of_lists)  # see ``kept``
            ctx.save_for_backward(*tensors, *memory, *memory_of_lists)
        render, render_rest = first.render, None
        if rest is not None:
            render, render_rest = render[..., :channels], render[..., channels:]
        thermal_images = (None, None) if second is None else (second.render, second.alphas)
        return render, render_rest, first.alphas, first.transmittance, *thermal_images

    @staticmethod
    @once_in_turns
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors, v = kept(ctx), BlendedTensors(*gradients)  # type: ignore[arg-type]
        arrays: BlendSaved = ctx.read
        saved = BlendSaved(*tensors[: len(arrays)])
        means2d, features, rest, thermal_opacities = saved.means2d, saved.features, saved.rest, saved.thermal_opacities
        projected, blended, settings, shown_means2d = ctx.projected, ctx.blended, ctx.settings, ctx.shown_means2d
        projected.roots.place(projected.packed_roots.ptr)
        # Stored where a thread has a Gaussian and not a rank, and there is a record; else added to.
        by_slot = ctx.bins.slots is not None
        added = by_slot or _sums_apart(ctx)
        like = torch.zeros_like if added else torch.empty_like
        new = means2d.new_zeros if added else means2d.new_empty
        found: list[Tensor | None] = [
            like(means2d),
            new(*saved.packed_roots.shape[:-1], 3),
            like(saved.opacities),
            None if thermal_opacities is None else like(thermal_opacities),
            _gradient_of_features(features, by_slot),
            None if rest is None else _gradient_of_features(rest, by_slot),
        ]
        absolute = None if shown_means2d is None else torch.zeros_like(means2d)
        v_alphas = v.alphas
        if v.transmittance is not None:
            v_alphas = -v.transmittance if v_alphas is None else v_alphas - v.transmittance
        inputs = (projected.means2d, projected.roots, *arrays[2:])
        with launches_on_torch_stream(means2d.device):
            for array, gradient in zip(inputs, found, strict=True):
                if gradient is not None:
                    array.gradient_at(gradient.data_ptr())
            lend(blended.transmittance, v_alphas)
            lend(blended.thermal_render, v.thermal_render)
            lend(blended.thermal_transmittance, v.thermal_alphas)
            size = blended.ends.shape
            v_images = (
                None if v.render is None else given_view(v.render, arrays.features.dtype, *size),
                None if v.rest is None else given_view(v.rest, arrays.rest.dtype, *size),
            )
            sums = None if absolute is None else view(absolute, projected.means2d.dtype)
            step = (projected, *arrays[2:5], ctx.bins, settings, blended, ctx.walk)
            v_given = {"v_images": v_images, "v_alphas": True, "absolute": sums, "launcher": ctx.launcher}
            blending_step.blend_adjoint(*step, rest=arrays.rest, **v_given, store=True)
        take_back(*inputs, blended.transmittance, blended.thermal_render, blended.thermal_transmittance)
        if absolute is not None:  # added up as .grad is: a call with many channels blends several times
            earlier = getattr(shown_means2d, "absgrad", None)
            shown_means2d.absgrad = absolute if earlier is None else earlier + absolute
        return *found, None


def _sums_apart(ctx: Any) -> bool:
    """Whether the adjoint adds all of a Gaussian's sums where gradients lie."""
    variant, by_slot = ctx.walk.variant, ctx.bins.slots is not None
    return sums_apart(variant.channels, variant.first_channels, by_slot, ctx.shown_means2d is not None)


def _gradient_of_features(features: Tensor, by_slot: bool) -> Tensor:
    """Memory for a gradient; that to many features is added to."""
    added = by_slot or features_apart(features.shape[-1], by_slot)
    return torch.zeros_like(features) if added else torch.empty_like(features)


def _make_images(
    means2d: Tensor, inputs: BlendInputs, channels: int
) -> tuple[ImageTensors, tuple[ArrayView, ArrayView, ArrayView, ArrayView]]:
    """The images of an opacity, not initialised, and as arrays."""
    settings, scalar, device = inputs.settings, inputs.opacities.dtype, inputs.opacities.device
    width, height = settings.width, settings.height
    rows, shape = (settings.num_images * height, width), (*inputs.images_shape, height, width)
    render, transmittance = means2d.new_empty(*shape, channels), means2d.new_empty(*shape, 1)
    ends, alphas = means2d.new_empty(*shape, 1, dtype=torch.int32), means2d.new_empty(*shape, 1)
    return ImageTensors(render, transmittance, ends, alphas), (
        ArrayView(render.data_ptr(), rows, vector_of(channels, means2d.dtype), device),
        ArrayView(transmittance.data_ptr(), rows, scalar, device),
        ArrayView(ends.data_ptr(), rows, wp.int32, device),
        ArrayView(alphas.data_ptr(), rows, scalar, device),
    )
