"""The step that blends each tile's Gaussians front to back: its launches, and its adjoint."""

import functools
import math
from typing import Any

import warp as wp

from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.blending.blend_layout import BlendLayout, default_layout
from warp_kernels.blending.blend_variant import BlendVariant, blend_variant
from warp_kernels.blending.blended_arrays import BlendedArrays, BlendLauncher, BlendWalk
from warp_kernels.blending.blending import blend_kernel
from warp_kernels.blending.blending_adjoint import blend_adjoint_kernel
from warp_kernels.blending.gradient_records import (
    distribute_kernel,
    finish_moments_kernel,
    kept_channels,
    record_length,
    sums_apart,
)
from warp_kernels.blending.list_segments import deal_states_kernel, join_segments_kernel
from warp_kernels.blending.pixel_ends import pair_bits
from warp_kernels.blending.segment_light import segment_light_kernel
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.machinery.array_views import ArrayView, empty, memory, zeros
from warp_kernels.machinery.lanes import whole_warps
from warp_kernels.machinery.launching import launch, launch_again, launch_tiles
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.tape_recording import gradient_of, record_adjoint
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings

WORTH_A_WAIT = 2**24
"""Bytes of room for states from which on the host waits to hear how many are needed. Frames with so many pairs and
channels take more than a millisecond; what the wait costs was not measured yet."""


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
    launcher: BlendLauncher | None = None,
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
        launcher: told of the launches that write images; None: they are made.

    Returns:
        What ``blend_adjoint`` needs beside the arguments.

    Raises:
        ValueError: if there are more channels than one traversal can blend.
    """
    device, dtype = opacities.device, opacities.dtype
    channels, thermal_channels = _channels(features, rest, blended)
    if channels > CHANNELS_MAX:
        raise ValueError(f"features must have at most {CHANNELS_MAX} channels a traversal, got {channels}.")
    num_tiles = bins.tile_offsets.shape[0] - 1
    if layout is None:
        of_frame = bins.expected_pairs, num_tiles
        layout = default_layout(device, bins.tile_size, channels, thermal_channels, dtype, *of_frame)
    variant = blend_variant(channels, thermal_channels, dtype, layout, features.dtype._length_)
    segment = layout.segment
    thermal_transmittance, _, thermal_ends = _thermal_images(blended)
    size, geometry = _read(projected, opacities, thermal_opacities, features, rest, bins, settings)
    walk = _cut_lists(variant, bins, num_tiles)
    cuts, states = walk.cuts, walk.states
    blocks = num_tiles + walk.rows
    lists = [*geometry, bins.tile_offsets, segment, cuts]
    # Where no list turns out to be cut, too: a call that is captured must find these kernels loaded.
    if segment > 0:
        launch_tiles(segment_light_kernel(variant), blocks, layout.threads, [*lists, states], device)
    written = [
        *lists,
        pair_bits(bins.num_pairs),
        blended.render,
        blended.transmittance,
        blended.ends,
        blended.alphas,
        blended.thermal_render,
        thermal_transmittance,
        thermal_ends,
        blended.thermal_alphas,
        states,
    ]
    joined = [*size, bins.tile_offsets, segment, cuts, blended.render, blended.thermal_render, states]

    def draw() -> None:
        launch_tiles(blend_kernel(variant), blocks, layout.threads, written, device)
        if segment > 0:
            launch(join_segments_kernel(variant), num_tiles * variant.state_length * bins.tile_size**2, joined, device)

    if launcher is None:
        draw()
    else:
        launcher.forward(draw, blended)
    if tape is not None:
        step = (projected, opacities, thermal_opacities, features, bins, settings, blended, walk)
        inputs = [projected.means2d, projected.roots, opacities, thermal_opacities, features]
        inputs += [] if rest is None else [rest]
        images = [blended.render, blended.transmittance, thermal_transmittance]
        images += [] if blended.thermal_render is None else [blended.thermal_render]
        adjoint = functools.partial(blend_adjoint, *step, rest=rest, absolute=absolute)
        record_adjoint(tape, adjoint, *inputs, *images)
    return walk


def _cut_lists(variant: BlendVariant, bins: TileBins, num_tiles: int) -> BlendWalk:
    """Finds the lists that are cut, and makes room for their states.

    No more boundaries lie in lists than segments in all pairs. Where room for so many is large, it is made for those
    that are needed, unless nothing may be read back.
    """
    device, dtype, segment = bins.tile_offsets.device, variant.dtype, variant.layout.segment
    if segment == 0:
        return BlendWalk(variant, None, None)
    rows = bins.num_pairs // segment
    cuts = zeros(num_tiles + rows + 1, wp.int32, device)
    launch_again(deal_states_kernel, num_tiles, [bins.tile_offsets, segment, cuts], device)
    size_of_state = (variant.state_length, bins.tile_size**2)
    if not bins.has_room and rows * math.prod(size_of_state) * wp.types.type_size_in_bytes(dtype) >= WORTH_A_WAIT:
        rows = memory.source.last(cuts)
    return BlendWalk(variant, cuts, empty((rows, *size_of_state), dtype, device), rows)


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
    launcher: BlendLauncher | None = None,
) -> None:
    """The adjoint of ``blend``: from the images' gradients to the inputs'. The other arguments are those of ``blend``.

    Args:
        blended: what ``blend`` wrote.
        walk: what ``blend`` returned.
        v_images: gradients of the render's first A channels and of the others, each an image or, for zeros, None;
            None: the render's own gradient.
        v_alphas: the transmittances' gradients are those to 1 - T.
        store: without ``bins.slots``, gradients of means2d, roots, opacities and few features (``features_apart``) are
            not initialised, and written; else they are added to, as those of many features are. Where there are no
            records (``sums_apart``), gradients of means2d, roots and opacities are zeros at first.
        launcher: told of the launch that reads the images' gradients; None: it is made.
    """
    device, variant = opacities.device, walk.variant
    layout, by_slot, absgrad = variant.layout, bins.slots is not None, absolute is not None
    apart = sums_apart(variant.channels, variant.first_channels, by_slot, absgrad)
    blend_kernel_back, distribute, record = _adjoint_kernels(variant, absgrad, by_slot)
    gaussians = features.shape[0]
    v_means2d, v_roots = gradient_of(projected.means2d), gradient_of(projected.roots)
    v_opacities, v_thermal_opacities = gradient_of(opacities), gradient_of(thermal_opacities)
    records, first_moments, second_moments = None, None, None
    if not apart:
        records = zeros(bins.num_pairs * layout.warps if by_slot else gaussians, record, device)
    elif store:
        first_moments, second_moments = v_means2d, v_roots
    else:
        first_moments, second_moments = (zeros(gaussians, one.dtype, device) for one in (v_means2d, v_roots))
    v_features = gradient_of(features)
    v_rest = None if rest is None else gradient_of(rest)
    v_render, v_render_rest = _parts(blended.render.grad, features, rest) if v_images is None else v_images
    thermal_transmittance, thermal_alphas, thermal_ends = _thermal_images(blended)
    v_thermal_render = None if blended.thermal_render is None else blended.thermal_render.grad
    draw_back = functools.partial(
        launch_tiles,
        blend_kernel_back,
        bins.tile_offsets.shape[0] - 1 + walk.rows,
        layout.threads,
        [
            *_read(projected, opacities, thermal_opacities, features, rest, bins, settings)[1],
            bins.tile_offsets,
            layout.segment,
            walk.cuts,
            bins.slots if by_slot else bins.gaussian_ids,
            walk.states,
            pair_bits(bins.num_pairs),
            blended.transmittance,
            blended.ends,
            blended.alphas,
            thermal_transmittance,
            thermal_ends,
            thermal_alphas,
            v_render,
            v_render_rest,
            -1.0 if v_alphas else 1.0,
            blended.transmittance.grad,
            v_thermal_render,
            thermal_transmittance.grad,
            records,
            first_moments,
            second_moments,
            v_opacities if apart else None,
            v_thermal_opacities if apart else None,
            v_features,
            v_rest,
        ],
        device,
    )
    if launcher is None:
        draw_back()
    else:
        v_second = None if blended.thermal_render is None else thermal_transmittance.grad
        v_transmittances = blended.transmittance.grad, v_second
        launcher.backward(draw_back, (v_render, v_render_rest, v_thermal_render, *v_transmittances))
    if apart:
        moments = [projected.roots, first_moments, second_moments, store, v_means2d, v_roots]
        launch_again(finish_moments_kernel(variant.dtype), whole_warps(gaussians, device), moments, device)
        return
    ranked = [bins.order, bins.pair_ends] if by_slot else [None, None]
    launch_again(
        distribute,
        whole_warps(bins.order.shape[0] if by_slot else gaussians, device),
        [
            *ranked,
            bins.tiles_per_gaussian,
            records,
            projected.roots,
            store and not by_slot,
            v_means2d,
            v_roots,
            v_opacities,
            v_thermal_opacities,
            v_features,
            v_rest,
            absolute if absolute is not None else projected.means2d,
        ],
        device,
    )


@made_once
def _adjoint_kernels(variant: BlendVariant, absgrad: bool, by_slot: bool) -> tuple[wp.Kernel, wp.Kernel, Any]:
    """The adjoint's two kernels, and the type of the records between them."""
    channels, first, thermal, dtype = (
        variant.channels,
        variant.first_channels,
        variant.thermal_channels,
        variant.dtype,
    )
    length = record_length(sum(kept_channels(channels, first, by_slot)), thermal, absgrad)
    return (
        blend_adjoint_kernel(variant, absgrad, by_slot),
        distribute_kernel(channels, thermal, dtype, absgrad, variant.layout.warps if by_slot else 0, first),
        wp.types.vector(length, dtype),
    )


def _channels(features: wp.array, rest: wp.array | None, blended: BlendedArrays) -> tuple[int, int]:
    """Channels blended with the first opacity and with the second, 0 where there is one."""
    thermal = blended.thermal_render.dtype._length_ if blended.thermal_render is not None else 0
    return features.dtype._length_ + (0 if rest is None else rest.dtype._length_), thermal


def _parts(
    image: wp.array | None, features: wp.array, rest: wp.array | None
) -> tuple[ArrayView | None, ArrayView | None]:
    """An image of all channels as one of the first and one of the others, on the same memory; None for what is not."""
    if image is None:
        return None, None
    first, device = features.dtype, image.device
    images = ArrayView(image.ptr, image.shape, first, device, image, image.strides)
    if rest is None:
        return images, None
    behind = image.ptr + wp.types.type_size_in_bytes(first)
    return images, ArrayView(behind, image.shape, rest.dtype, device, image, image.strides)


def _thermal_images(blended: BlendedArrays) -> tuple[wp.array, wp.array | None, wp.array]:
    """Transmittance, alphas and ends of the second opacity, or of the only one."""
    if blended.thermal_render is not None:
        return blended.thermal_transmittance, blended.thermal_alphas, blended.thermal_ends
    return blended.transmittance, blended.alphas, blended.ends


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
    return size, [*size, *gaussians, features, rest, bins.gaussian_ids, bins.masks]
