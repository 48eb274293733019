"""The launches of the rasterizer in order, each with its adjoint recorded on a ``wp.Tape``.

Four steps: ``project``, ``sh_colors``, ``bin_tiles``, ``blend``. A step writes into arrays it is given; with a tape it
records its adjoint, which *adds* to the ``.grad`` of its inputs that have one and reads the ``.grad`` of its outputs.
``rasterize`` chains them for users of Warp alone. All arrays are flat, as described in projection.
"""

from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

from warp_kernels.blend_layout import BlendLayout, default_layout
from warp_kernels.blending import blend_kernel
from warp_kernels.blending_adjoint import blend_adjoint_kernel, distribute_kernel, record_length
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.launching import launch, launch_tiles
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings, projection_kernel
from warp_kernels.projection_adjoint import (
    CAMERA_RECORD,
    camera_finish_kernel,
    projection_adjoint_kernel,
)
from warp_kernels.spherical_harmonics import camera_position_adjoint_kernel, color_adjoint_kernel, color_kernel
from warp_kernels.strand_sums import strand_sums
from warp_kernels.tile_binning import TileBins, binning_kernels, tile_ranges_kernel


class TooManyPairsError(ValueError):
    """More (Gaussian, tile) pairs than 32-bit indices can number."""


def _gradient(array: wp.array) -> wp.array:
    """The gradient of an array, or a throw-away one where nobody wants it."""
    return array.grad if array.grad is not None else wp.zeros_like(array)


def _record(tape: wp.Tape, adjoint: Callable[[], None], *arrays: wp.array) -> None:
    """Records an adjoint; the arrays that already have gradients are those ``tape.zero()`` will clear."""
    tape.record_func(adjoint, [array for array in arrays if array.grad is not None])


def project(
    gaussians: GaussianArrays, settings: ProjectionSettings, projected: ProjectedArrays, tape: wp.Tape | None = None
) -> None:
    """Projects Gaussians to the image plane.

    Args:
        gaussians: inputs. Gradients go to means, quats and scales (or covars), viewmats and Ks where they have one.
        settings: image size, planes and mode.
        projected: outputs, one entry an (image, Gaussian) pair.
        tape: records the adjoint; gradients come from means2d, depths, conics and compensations.
    """
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    from_covars = gaussians.covars is not None
    covars = gaussians.covars if from_covars else wp.empty(0, dtype=wp.types.vector(6, dtype), device=device)
    kernel = projection_kernel(dtype, settings.camera_model, from_covars)
    pairs = len(projected.means2d)
    launch(
        kernel,
        pairs,
        [
            settings.num_gaussians,
            settings.num_cameras,
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            covars,
            gaussians.opacities,
            gaussians.thermal_opacities,
            gaussians.viewmats,
            gaussians.Ks,
            settings.width,
            settings.height,
            dtype(settings.eps2d),
            dtype(settings.near_plane),
            dtype(settings.far_plane),
            dtype(settings.radius_clip),
            settings.antialiased,
            projected.means2d,
            projected.depths,
            projected.conics,
            projected.compensations,
            projected.radii,
            projected.extents,
        ],
        device,
    )
    if tape is None:
        return

    def adjoint() -> None:
        to_cameras = gaussians.viewmats.grad is not None or gaussians.Ks.grad is not None
        record = wp.types.vector(CAMERA_RECORD, dtype)
        v_cameras = wp.empty(pairs if to_cameras else 0, dtype=record, device=device)
        launch(
            projection_adjoint_kernel(dtype, settings.camera_model, from_covars, to_cameras),
            len(gaussians.means),
            [
                settings.num_gaussians,
                settings.num_cameras,
                gaussians.means,
                gaussians.quats,
                gaussians.scales,
                covars,
                gaussians.viewmats,
                gaussians.Ks,
                settings.width,
                settings.height,
                dtype(settings.eps2d),
                settings.antialiased,
                projected.conics,
                projected.compensations,
                projected.radii,
                _gradient(projected.means2d),
                _gradient(projected.depths),
                _gradient(projected.conics),
                _gradient(projected.compensations),
                _gradient(gaussians.means),
                _gradient(gaussians.quats),
                _gradient(gaussians.scales),
                _gradient(covars),
                v_cameras,
            ],
            device,
        )
        if to_cameras:
            wp.launch(
                camera_finish_kernel(dtype),
                dim=len(gaussians.viewmats),
                inputs=[
                    strand_sums(v_cameras, settings.num_images),
                    _gradient(gaussians.viewmats),
                    _gradient(gaussians.Ks),
                ],
                device=device,
                record_tape=False,
            )

    g, p = gaussians, projected
    inputs = [g.means, g.quats, g.scales, g.viewmats, g.Ks, *([g.covars] if g.covars is not None else [])]
    _record(tape, adjoint, *inputs, p.means2d, p.depths, p.conics, p.compensations)


def sh_colors(
    degree: int,
    means: wp.array,
    camera_positions: wp.array,
    coefficients: wp.array,
    radii: wp.array,
    colors: wp.array,
    num_gaussians: int,
    num_cameras: int,
    per_image: bool = False,
    tape: wp.Tape | None = None,
) -> None:
    """Evaluates spherical harmonics in each Gaussian's view direction; zero where it is culled.

    Args:
        degree: 0 to 3.
        means: vec3 [scenes · N]. Receives a gradient.
        camera_positions: vec3 [images], world units. Receives a gradient.
        coefficients: vec3 [scenes · N, K], or [images · N, K] for coefficients of their own per image; K at least
            (degree + 1)². Receives a gradient.
        radii: vec2i [images · N] from the projection.
        colors: vec3 [images · N], output.
        num_gaussians: N.
        num_cameras: cameras per scene.
        per_image: coefficients are per (image, Gaussian).
        tape: records the adjoint.
    """
    device = means.device
    dtype = means.dtype._wp_scalar_type_
    arguments = [num_gaussians, num_cameras, per_image, degree, means, camera_positions, coefficients, radii, colors]
    launch(color_kernel(dtype), len(colors), arguments, device)
    if tape is None:
        return

    def adjoint() -> None:
        v_offsets = wp.empty_like(colors)
        launch(
            color_adjoint_kernel(dtype),
            len(means),
            [*arguments, _gradient(colors), _gradient(coefficients), _gradient(means), v_offsets],
            device,
        )
        if camera_positions.grad is not None:
            wp.launch(
                camera_position_adjoint_kernel(dtype),
                dim=len(camera_positions),
                inputs=[strand_sums(v_offsets, len(camera_positions)), camera_positions.grad],
                device=device,
                record_tape=False,
            )

    _record(tape, adjoint, means, camera_positions, coefficients, colors)


def bin_tiles(
    projected: ProjectedArrays,
    opacities: wp.array,
    thermal_opacities: wp.array,
    features: wp.array,
    settings: ProjectionSettings,
    tile_size: int,
    *,
    by_slot: bool,
) -> TileBins:
    """Lists the Gaussians of each tile in depth order. Reads the number of pairs back to the host once.

    Args:
        projected: from ``project``. Radii of Gaussians with non-finite features are set to zero.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same array where there is one opacity.
        features: scalar array [images · N, D], only checked for being finite.
        settings: image size.
        tile_size: edge of a tile [px].
        by_slot: number the pairs, for an adjoint that writes one record a pair.

    Returns:
        The bins.

    Raises:
        TooManyPairsError: if the pairs exceed what 32-bit indices can number.
    """
    device, dtype = opacities.device, opacities.dtype
    count_kernel, gather_kernel, emit_kernel = binning_kernels(dtype)
    entries = len(projected.means2d)
    tiles_x, tiles_y = -(-settings.width // tile_size), -(-settings.height // tile_size)
    num_tiles = settings.num_images * tiles_x * tiles_y

    tiles_per_gaussian = wp.empty(entries, dtype=wp.int32, device=device)
    # radix_sort_pairs sorts in place and needs room for a second copy
    depth_keys = wp.empty(2 * entries, dtype=dtype, device=device)
    order = wp.empty(2 * entries, dtype=wp.int32, device=device)
    launch(
        count_kernel,
        entries,
        [
            settings.width,
            settings.height,
            tile_size,
            projected.means2d,
            projected.conics,
            projected.extents,
            projected.depths,
            opacities,
            thermal_opacities,
            features,
            projected.radii,
            tiles_per_gaussian,
            depth_keys,
            order,
        ],
        device,
    )
    pair_ends = wp.empty(entries, dtype=wp.int64, device=device)
    num_pairs = 0
    if entries > 0:
        wp.utils.radix_sort_pairs(depth_keys, order, entries)
        wp.launch(
            gather_kernel,
            dim=entries,
            inputs=[order, tiles_per_gaussian, pair_ends],
            device=device,
            record_tape=False,
        )
        wp.utils.array_scan(pair_ends, pair_ends, inclusive=True)
        num_pairs = int(pair_ends[entries - 1 :].numpy()[0])
    if num_pairs >= 2**31 or num_tiles >= 2**31:
        raise TooManyPairsError(
            f"{num_pairs:,} overlaps of {settings.num_gaussians:,} Gaussians with tiles of {tile_size} px exceed the "
            f"{2**31 - 1:,} that one call can hold; render fewer cameras per call, a smaller image, or smaller scales."
        )

    keys = wp.empty(2 * num_pairs, dtype=wp.int32, device=device)
    values = wp.empty(2 * num_pairs, dtype=wp.int32, device=device)
    owners = wp.empty(num_pairs if by_slot else 0, dtype=wp.int32, device=device)
    gaussian_ids = wp.empty(num_pairs, dtype=wp.int32, device=device)
    tile_offsets = wp.empty(num_tiles + 1, dtype=wp.int32, device=device)
    if num_pairs > 0:
        launch(
            emit_kernel,
            entries,
            [
                settings.num_gaussians,
                settings.width,
                settings.height,
                tile_size,
                tiles_x,
                tiles_y,
                by_slot,
                projected.means2d,
                projected.conics,
                projected.extents,
                opacities,
                thermal_opacities,
                order,
                tiles_per_gaussian,
                pair_ends,
                keys,
                values,
                owners,
            ],
            device,
        )
        wp.utils.radix_sort_pairs(keys, values, num_pairs, 0, max(1, (num_tiles - 1).bit_length()))
    wp.launch(
        tile_ranges_kernel,
        dim=num_pairs + 1,
        inputs=[num_pairs, num_tiles, by_slot, keys, values, owners, tile_offsets, gaussian_ids],
        device=device,
        record_tape=False,
    )
    return TileBins(
        gaussian_ids=gaussian_ids,
        tile_offsets=tile_offsets,
        order=order[:entries] if entries else order,
        pair_ends=pair_ends,
        tiles_per_gaussian=tiles_per_gaussian,
        slots=values if by_slot else None,
        num_pairs=num_pairs,
        tile_size=tile_size,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
    )


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
        projected: means2d and conics receive gradients.
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
        pairs_per_tile = bins.num_pairs / num_tiles
        layout = default_layout(device, bins.tile_size, channels + thermal_channels, dtype, pairs_per_tile)

    nothing = wp.empty((0, 0), dtype=wp.types.vector(max(thermal_channels, 1), dtype), device=device)
    thermal_render = blended.thermal_render if dual else nothing
    thermal_transmittance = blended.thermal_transmittance if dual else blended.transmittance
    thermal_last_pairs = blended.thermal_last_pairs if dual else blended.last_pairs
    geometry = [
        bins.tiles_x,
        bins.tiles_y,
        settings.width,
        settings.height,
        projected.means2d,
        projected.conics,
        projected.extents,
        opacities,
        thermal_opacities,
        features,
        bins.gaussian_ids,
    ]
    launch_tiles(
        blend_kernel(channels, thermal_channels, dtype, layout),
        num_tiles,
        layout.threads,
        [
            *geometry,
            bins.tile_offsets,
            blended.render,
            blended.transmittance,
            blended.last_pairs,
            thermal_render,
            thermal_transmittance,
            thermal_last_pairs,
        ],
        device,
    )
    if tape is None:
        return

    def adjoint() -> None:
        record = wp.types.vector(record_length(channels, thermal_channels, absolute is not None), dtype)
        records = wp.zeros(bins.num_pairs if by_slot else len(features), dtype=record, device=device)
        launch_tiles(
            blend_adjoint_kernel(channels, thermal_channels, dtype, layout, absolute is not None, by_slot),
            num_tiles,
            layout.threads,
            [
                *geometry,
                bins.slots if by_slot else bins.gaussian_ids,
                bins.tile_offsets,
                blended.transmittance,
                blended.last_pairs,
                thermal_transmittance,
                thermal_last_pairs,
                _gradient(blended.render),
                _gradient(blended.transmittance),
                _gradient(thermal_render),
                _gradient(thermal_transmittance),
                records,
            ],
            device,
        )
        wp.launch(
            distribute_kernel(channels, thermal_channels, dtype, absolute is not None, by_slot),
            dim=len(features),
            inputs=[
                bins.order,
                bins.pair_ends,
                bins.tiles_per_gaussian,
                records,
                _gradient(projected.means2d),
                _gradient(projected.conics),
                _gradient(opacities),
                _gradient(thermal_opacities),
                _gradient(features),
                absolute if absolute is not None else projected.means2d,
            ],
            device=device,
            record_tape=False,
        )

    inputs = [projected.means2d, projected.conics, opacities, thermal_opacities, features]
    images = [blended.render, blended.transmittance, thermal_render, thermal_transmittance]
    _record(tape, adjoint, *inputs, *images)


@dataclass
class Rasterization:
    """Result of ``rasterize``.

    Attributes:
        projected: projected Gaussians.
        bins: Gaussians of each tile.
        blended: the images.
    """

    projected: ProjectedArrays
    bins: TileBins
    blended: BlendedArrays


def allocate_projected(entries: int, dtype: type, device: wp.Device, requires_grad: bool) -> ProjectedArrays:
    """Arrays for ``project`` to write.

    Args:
        entries: images · N.
        dtype: ``wp.float32`` or ``wp.float64``.
        device: where they live.
        requires_grad: give them gradients.

    Returns:
        The arrays, not initialised.
    """
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)

    def empty(kind: type) -> wp.array:
        return wp.empty(entries, dtype=kind, device=device, requires_grad=requires_grad)

    radii = wp.empty(entries, dtype=wp.vec2i, device=device)
    extents = wp.empty(entries, dtype=vec2, device=device)
    return ProjectedArrays(empty(vec2), empty(dtype), empty(vec3), empty(dtype), radii, extents)


def rasterize(
    gaussians: GaussianArrays,
    features: wp.array,
    settings: ProjectionSettings,
    tape: wp.Tape | None = None,
    *,
    tile_size: int = 16,
    thermal_channels: int = 0,
) -> Rasterization:
    """Projects, bins and blends, for users of Warp alone (one scene, features per image, classic opacities).

    Args:
        gaussians: inputs; gradients go to those with ``requires_grad``.
        features: vecC [images · N].
        settings: image size, planes and mode; ``antialiased`` must be off.
        tape: records the adjoints. Set ``result.blended.render.grad`` (and transmittance's), then ``tape.backward()``.
        tile_size: edge of a tile [px].
        thermal_channels: blend the last so many channels a second time with ``gaussians.thermal_opacities``.

    Returns:
        Everything the steps made.

    Raises:
        ValueError: if ``settings`` or the number of images ask for what this shortcut does not do.
    """
    images = len(gaussians.viewmats)
    if settings.antialiased or images != 1:
        raise ValueError("rasterize() renders one image in the classic mode; chain the four steps for anything else.")
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    projected = allocate_projected(images * settings.num_gaussians, dtype, device, tape is not None)
    project(gaussians, settings, projected, tape)
    shape = (images * settings.height, settings.width)

    def image(kind: type) -> wp.array:
        return wp.empty(shape, dtype=kind, device=device, requires_grad=tape is not None and kind is not wp.int32)

    blended = BlendedArrays(image(features.dtype), image(dtype), image(wp.int32))
    if thermal_channels:
        blended.thermal_render = image(wp.types.vector(thermal_channels, dtype))
        blended.thermal_transmittance, blended.thermal_last_pairs = image(dtype), image(wp.int32)
    opacities, thermal_opacities = gaussians.opacities, gaussians.thermal_opacities
    by_slot = not device.is_cuda
    bins = bin_tiles(
        projected, opacities, thermal_opacities, scalar_view(features), settings, tile_size, by_slot=by_slot
    )
    blend(projected, opacities, thermal_opacities, features, bins, settings, blended, tape)
    return Rasterization(projected, bins, blended)


def scalar_view(features: wp.array) -> wp.array:
    """The same memory as a two-dimensional array of scalars.

    Args:
        features: contiguous vecC [M].

    Returns:
        Scalar array [M, C].
    """
    kind = features.dtype
    return wp.array(
        ptr=features.ptr,
        shape=(len(features), kind._length_),
        dtype=kind._wp_scalar_type_,
        device=features.device,
        copy=False,
    )
