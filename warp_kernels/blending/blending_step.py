"""The step that blends each tile's Gaussians front to back: its launches, and its adjoint."""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.blending.blend_layout import BlendLayout, default_layout
from warp_kernels.blending.blend_variant import BlendVariant, blend_variant
from warp_kernels.blending.blending import blend_kernel
from warp_kernels.blending.blending_adjoint import blend_adjoint_kernel
from warp_kernels.blending.gradient_records import distribute_kernel, kept_channels, record_length
from warp_kernels.blending.list_segments import join_segments_kernel
from warp_kernels.blending.segment_light import segment_light_kernel
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.machinery.array_views import ArrayView, empty, nothing, zeros
from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import launch, launch_again, launch_tiles
from warp_kernels.machinery.tape_recording import given_gradient, gradient_of, record_adjoint
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings


@dataclass
class BlendedArrays:
    """Images the blending writes; rows are image · height + y.

    Attributes:
        render: vecC [images · height, width].
        transmittance: [images · height, width]; 1 - alpha.
        last_pairs: int32 [images · height, width]; last sorted pair drawn, -1 where none.
        alphas: [images · height, width]; None: not wanted.
        thermal_render: vecD [images · height, width]; None with one opacity.
        thermal_transmittance: as ``transmittance``, of the second opacity.
        thermal_last_pairs: as ``last_pairs``, of the second opacity.
        thermal_alphas: as ``alphas``, of the second opacity.
    """

    render: wp.array
    transmittance: wp.array
    last_pairs: wp.array
    alphas: wp.array | None = None
    thermal_render: wp.array | None = None
    thermal_transmittance: wp.array | None = None
    thermal_last_pairs: wp.array | None = None
    thermal_alphas: wp.array | None = None


@dataclass(frozen=True)
class BlendWalk:
    """How lists were walked, as their adjoint walks them back.

    Attributes:
        variant: of the kernels.
        states: [boundaries, state_length, pixels of a tile] what each segment of a cut list left; see list_segments.
    """

    variant: BlendVariant
    states: wp.array


def blend(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    bins: TileBins,
    settings: ProjectionSettings,
    blended: BlendedArrays,
    tape: wp.Tape | None = None,
    *,
    rest: wp.array | None = None,
    absolute: wp.array | None = None,
    layout: BlendLayout | None = None,
) -> BlendWalk:
    """Blends features front to back, with one opacity or two in one traversal.

    Args:
        projected: means2d and roots receive gradients.
        opacities: [images · N], compensation included. Receives a gradient.
        thermal_opacities: [images · N]; read only when ``blended.thermal_render`` is given. Receives a gradient.
        features: vecA [images · N]. Receives a gradient.
        bins: from ``bin_tiles``; made with ``by_slot``, the adjoint is deterministic.
        settings: image size.
        blended: outputs.
        tape: records the adjoint; gradients come from the renders and transmittances.
        rest: vecB [images · N], channels after those of ``features``, C = A + B at most ``CHANNELS_MAX``;
            None: there are no others, C = A. Receives a gradient.
        absolute: vec2 [images · N]; the adjoint adds the sums of absolute mean2d gradients (AbsGS) here.
        layout: deal of pixels to lanes; None for the device's default.

    Returns:
        What ``blend_adjoint`` needs beside the arguments.

    Raises:
        ValueError: if there are more channels than one traversal can blend.
    """
    device, dtype = opacities.device, opacities.dtype
    channels, thermal_channels = _channels(features, rest, blended)
    if channels > CHANNELS_MAX:
        raise ValueError(f"features must have at most {CHANNELS_MAX} channels a traversal, got {channels}.")
    num_tiles = len(bins.tile_offsets) - 1
    if layout is None:
        of_frame = bins.expected_pairs, num_tiles
        layout = default_layout(device, bins.tile_size, channels, thermal_channels, dtype, *of_frame)
    variant = blend_variant(channels, thermal_channels, dtype, layout, features.dtype._length_)
    segment = layout.segment
    num_states = bins.num_pairs // segment + 1 if segment > 0 else 0
    size_of_state = (variant.state_length, bins.tile_size**2)
    states = empty((num_states, *size_of_state), dtype, device) if num_states > 0 else nothing(dtype, 3, device)

    thermal_render = _thermal_render(blended, dtype, device)
    thermal_transmittance, thermal_last_pairs = _thermal_images(blended)
    size, geometry = _read(projected, opacities, thermal_opacities, features, rest, bins, settings)
    alphas, thermal_alphas = (
        nothing(dtype, 2, device) if image is None else image for image in (blended.alphas, blended.thermal_alphas)
    )
    blocks = num_tiles + num_states
    lists = [*geometry, bins.tile_offsets, segment]
    if segment > 0:
        launch_tiles(segment_light_kernel(variant), blocks, layout.threads, [*lists, states], device)
    launch_tiles(
        blend_kernel(variant),
        blocks,
        layout.threads,
        [
            *lists,
            blended.render,
            blended.transmittance,
            blended.last_pairs,
            alphas,
            thermal_render,
            thermal_transmittance,
            thermal_last_pairs,
            thermal_alphas,
            states,
        ],
        device,
    )
    if segment > 0:
        launch(
            join_segments_kernel(variant),
            num_tiles * variant.state_length * bins.tile_size**2,
            [*size, bins.tile_offsets, segment, blended.render, thermal_render, states],
            device,
        )
    walk = BlendWalk(variant, states)
    if tape is not None:
        step = (projected, opacities, thermal_opacities, features, bins, settings, blended, walk)
        inputs = [projected.means2d, projected.roots, opacities, thermal_opacities, features]
        inputs += [] if rest is None else [rest]
        images = [blended.render, blended.transmittance, thermal_render, thermal_transmittance]
        adjoint = functools.partial(blend_adjoint, *step, rest=rest, absolute=absolute)
        record_adjoint(tape, adjoint, *inputs, *images)
    return walk


def blend_adjoint(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    bins: TileBins,
    settings: ProjectionSettings,
    blended: BlendedArrays,
    walk: BlendWalk,
    *,
    rest: wp.array | None = None,
    v_images: tuple[Any, Any] | None = None,
    v_alphas: bool = False,
    absolute: wp.array | None = None,
    store: bool = False,
) -> None:
    """The adjoint of ``blend``: from the images' gradients to the inputs'.

    Args:
        projected: as in ``blend``.
        opacities: as in ``blend``.
        thermal_opacities: as in ``blend``.
        features: as in ``blend``.
        bins: as in ``blend``.
        settings: as in ``blend``.
        blended: what ``blend`` wrote.
        walk: what ``blend`` returned.
        rest: as in ``blend``.
        v_images: gradients of the render's first A channels and of the others, each an image or, for zeros, without
            elements; None: the render's own gradient.
        v_alphas: the transmittances' gradients are those to 1 - T.
        absolute: as in ``blend``.
        store: without ``bins.slots``, gradients of means2d, roots, opacities and few features (``features_apart``) are
            not initialised, and written; else they are added to, as those of many features are.
    """
    device, dtype, variant = opacities.device, opacities.dtype, walk.variant
    channels, thermal_channels, layout = variant.channels, variant.thermal_channels, variant.layout
    first_channels = variant.first_channels
    by_slot, absgrad = bins.slots is not None, absolute is not None
    length = record_length(sum(kept_channels(channels, first_channels, by_slot)), thermal_channels, absgrad)
    per_pair = layout.warps if by_slot else 0
    count = bins.num_pairs * per_pair if by_slot else len(features)
    records = zeros(count, wp.types.vector(length, dtype), device)
    v_features = gradient_of(features)
    v_rest = _or_nothing(None if rest is None else gradient_of(rest), dtype, device)
    if v_images is None:
        v_images = _parts(given_gradient(blended.render), features, rest)
    v_render, v_render_rest = v_images
    thermal_render = _thermal_render(blended, dtype, device)
    thermal_transmittance, thermal_last_pairs = _thermal_images(blended)
    launch_tiles(
        blend_adjoint_kernel(variant, absgrad, by_slot),
        len(bins.tile_offsets) - 1 + len(walk.states),
        layout.threads,
        [
            *_read(projected, opacities, thermal_opacities, features, rest, bins, settings)[1],
            bins.slots if by_slot else bins.gaussian_ids,
            bins.tile_offsets,
            layout.segment,
            walk.states,
            blended.transmittance,
            blended.last_pairs,
            thermal_transmittance,
            thermal_last_pairs,
            v_render,
            v_render_rest,
            -1.0 if v_alphas else 1.0,
            given_gradient(blended.transmittance),
            given_gradient(thermal_render),
            given_gradient(thermal_transmittance),
            records,
            v_features,
            v_rest,
        ],
        device,
    )
    ranked = [bins.order, bins.pair_ends] if by_slot else [nothing(k, 1, device) for k in (wp.int32, wp.int64)]
    launch_again(
        distribute_kernel(channels, thermal_channels, dtype, absgrad, per_pair, first_channels),
        whole_warps(len(bins.order) if by_slot else len(features), device),
        [
            *ranked,
            bins.tiles_per_gaussian,
            records,
            projected.roots,
            store and not by_slot,
            gradient_of(projected.means2d),
            gradient_of(projected.roots),
            gradient_of(opacities),
            gradient_of(thermal_opacities),
            v_features,
            v_rest,
            absolute if absolute is not None else projected.means2d,
        ],
        device,
    )


def _channels(features: wp.array, rest: wp.array | None, blended: BlendedArrays) -> tuple[int, int]:
    """Channels blended with the first opacity and with the second, 0 where there is one."""
    thermal = blended.thermal_render.dtype._length_ if blended.thermal_render is not None else 0
    return features.dtype._length_ + (0 if rest is None else rest.dtype._length_), thermal


def _or_nothing(rest: wp.array | None, dtype: type, device: wp.Device) -> wp.array:
    """The other channels, or an array without elements where there are none."""
    return nothing(wp.types.vector(1, dtype), 1, device) if rest is None else rest


def _parts(image: wp.array, features: wp.array, rest: wp.array | None) -> tuple[ArrayView, ArrayView]:
    """An image of all channels as one of the first and one of the others, on the same memory."""
    first, device = features.dtype, image.device
    images = ArrayView(image.ptr, image.shape, first, device, image, image.strides)
    if rest is None:
        return images, nothing(wp.types.vector(1, first._wp_scalar_type_), 2, device)
    behind = image.ptr + wp.types.type_size_in_bytes(first)
    return images, ArrayView(behind, image.shape, rest.dtype, device, image, image.strides)


def _thermal_render(blended: BlendedArrays, dtype: type, device: wp.Device) -> wp.array:
    if blended.thermal_render is not None:
        return blended.thermal_render
    return nothing(wp.types.vector(1, dtype), 2, device)


def _thermal_images(blended: BlendedArrays) -> tuple[wp.array, wp.array]:
    """Transmittance and last pairs of the second opacity, or of the only one."""
    if blended.thermal_render is not None:
        return blended.thermal_transmittance, blended.thermal_last_pairs
    return blended.transmittance, blended.last_pairs


def _read(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    rest: wp.array | None,
    bins: TileBins,
    settings: ProjectionSettings,
) -> tuple[list[int], list[Any]]:
    """The image's size, and what both the kernel and its adjoint begin with."""
    size = [bins.tiles_x, bins.tiles_y, settings.width, settings.height]
    p = projected
    gaussians = [p.means2d, p.packed_roots, p.extents, opacities, thermal_opacities]
    others = _or_nothing(rest, opacities.dtype, opacities.device)
    return size, [*size, *gaussians, features, others, bins.gaussian_ids, bins.masks]
