"""The step that blends each tile's Gaussians front to back: its launches, and its adjoint on a tape."""

from dataclasses import dataclass

import warp as wp

from warp_kernels.array_views import empty, nothing, zeros
from warp_kernels.blend_layout import BlendLayout, default_layout
from warp_kernels.blending import blend_kernel
from warp_kernels.blending_adjoint import blend_adjoint_kernel
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.gradient_records import distribute_kernel, record_length
from warp_kernels.launching import launch, launch_again, launch_tiles
from warp_kernels.list_segments import join_segments_kernel, state_length
from warp_kernels.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.tape_recording import gradient_of, record_adjoint
from warp_kernels.tile_binning import TileBins


@dataclass
class BlendedArrays:
    """Images the blending writes; rows are image · height + y.

    Attributes:
        render: vecC [images · height, width].
        transmittance: [images · height, width]; 1 - alpha.
        last_pairs: int32 [images · height, width]; last sorted pair drawn, -1 where none.
        thermal_render: vecD [images · height, width]; None with one opacity.
        thermal_transmittance: as ``transmittance``, of the second opacity.
        thermal_last_pairs: as ``last_pairs``, of the second opacity.
    """

    render: wp.array
    transmittance: wp.array
    last_pairs: wp.array
    thermal_render: wp.array | None = None
    thermal_transmittance: wp.array | None = None
    thermal_last_pairs: wp.array | None = None


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
    absolute: wp.array | None = None,
    layout: BlendLayout | None = None,
) -> None:
    """Blends features front to back, with one opacity or two in one traversal.

    Args:
        projected: means2d and roots receive gradients.
        opacities: [images · N], compensation included. Receives a gradient.
        thermal_opacities: [images · N]; read only when ``blended.thermal_render`` is given. Receives a gradient.
        features: vecC [images · N], C at most ``CHANNELS_MAX``. Receives a gradient.
        bins: from ``bin_tiles``; made with ``by_slot``, the adjoint is deterministic.
        settings: image size.
        blended: outputs.
        tape: records the adjoint; gradients come from the renders and transmittances.
        absolute: vec2 [images · N]; the adjoint adds the sums of absolute mean2d gradients (AbsGS) here.
        layout: deal of pixels to lanes; None for the device's default.

    Raises:
        ValueError: if there are more channels than one traversal can blend.
    """
    device, dtype = opacities.device, opacities.dtype
    channels = features.dtype._length_
    dual = blended.thermal_render is not None
    thermal_channels = blended.thermal_render.dtype._length_ if blended.thermal_render is not None else 0
    if channels > CHANNELS_MAX:
        raise ValueError(f"features must have at most {CHANNELS_MAX} channels a traversal, got {channels}.")
    by_slot = bins.slots is not None
    num_tiles = len(bins.tile_offsets) - 1
    if layout is None:
        layout = default_layout(device, bins.tile_size, channels + thermal_channels, dtype, bins.num_pairs, num_tiles)
    segment = layout.segment
    num_states = bins.num_pairs // segment + 1 if segment > 0 else 0
    length = state_length(channels, thermal_channels)
    states = empty((num_states, length, bins.tile_size**2), dtype, device)

    no_render = nothing(wp.types.vector(max(thermal_channels, 1), dtype), 2, device)
    thermal_render = blended.thermal_render if dual else no_render
    thermal_transmittance = blended.thermal_transmittance if dual else blended.transmittance
    thermal_last_pairs = blended.thermal_last_pairs if dual else blended.last_pairs
    size = [bins.tiles_x, bins.tiles_y, settings.width, settings.height]
    geometry = [
        *size,
        projected.means2d,
        projected.roots,
        projected.extents,
        opacities,
        thermal_opacities,
        features,
        bins.gaussian_ids,
    ]
    for only_transmittance in (True, False) if segment > 0 else (False,):
        launch_tiles(
            blend_kernel(channels, thermal_channels, dtype, layout, only_transmittance),
            num_tiles + num_states,
            layout.threads,
            [
                *geometry,
                bins.tile_offsets,
                segment,
                blended.render,
                blended.transmittance,
                blended.last_pairs,
                thermal_render,
                thermal_transmittance,
                thermal_last_pairs,
                states,
            ],
            device,
        )
    if segment > 0:
        launch(
            join_segments_kernel(channels, thermal_channels, dtype, layout),
            num_tiles * length * bins.tile_size**2,
            [*size, bins.tile_offsets, segment, blended.render, thermal_render, states],
            device,
        )
    if tape is None:
        return

    def adjoint() -> None:
        record = wp.types.vector(record_length(channels, thermal_channels, absolute is not None), dtype)
        per_pair = layout.warps if by_slot else 0
        records = zeros(bins.num_pairs * per_pair if by_slot else len(features), record, device)
        launch_tiles(
            blend_adjoint_kernel(channels, thermal_channels, dtype, layout, absolute is not None, by_slot),
            num_tiles + num_states,
            layout.threads,
            [
                *geometry,
                bins.slots if by_slot else bins.gaussian_ids,
                bins.tile_offsets,
                segment,
                states,
                blended.transmittance,
                blended.last_pairs,
                thermal_transmittance,
                thermal_last_pairs,
                gradient_of(blended.render),
                gradient_of(blended.transmittance),
                gradient_of(thermal_render),
                gradient_of(thermal_transmittance),
                records,
            ],
            device,
        )
        ranked = [bins.order, bins.pair_ends] if by_slot else [nothing(k, 1, device) for k in (wp.int32, wp.int64)]
        launch_again(
            distribute_kernel(channels, thermal_channels, dtype, absolute is not None, per_pair),
            len(bins.order) if by_slot else len(features),
            [
                *ranked,
                bins.tiles_per_gaussian,
                records,
                projected.roots,
                gradient_of(projected.means2d),
                gradient_of(projected.roots),
                gradient_of(opacities),
                gradient_of(thermal_opacities),
                gradient_of(features),
                absolute if absolute is not None else projected.means2d,
            ],
            device,
        )

    inputs = [projected.means2d, projected.roots, opacities, thermal_opacities, features]
    images = [blended.render, blended.transmittance, thermal_render, thermal_transmittance]
    record_adjoint(tape, adjoint, *inputs, *images)
