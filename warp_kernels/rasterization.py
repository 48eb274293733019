"""The steps of the rasterizer chained, for users of Warp alone.

Four steps: ``project_gaussians``, ``sh_colors``, ``bin_tiles``, ``blend``, each in a module of its own. A step writes
into arrays it is given; with a tape it records its adjoint, which *adds* to the ``.grad`` of its inputs that have one
and reads the ``.grad`` of its outputs. All arrays are flat, as described in projection.
"""

from dataclasses import dataclass

import warp as wp

from warp_kernels.binning.binning_step import bin_tiles
from warp_kernels.binning.tile_bins import TileBins
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.blending.blending_step import blend
from warp_kernels.projection.plain_camera_step import project_gaussians
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings


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
    """Arrays for ``project_gaussians`` to write.

    Args:
        entries: images · N.
        device: where they live.
        requires_grad: give them gradients.
    """
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))

    def empty(kind: type) -> wp.array:
        return wp.empty(entries, dtype=kind, device=device, requires_grad=requires_grad)

    visible = wp.empty(entries, dtype=wp.bool, device=device)
    extents = wp.empty(entries, dtype=vec2, device=device)
    packed_roots = wp.empty(entries, dtype=vec4, device=device)
    strides = packed_roots.strides
    roots = wp.array(ptr=packed_roots.ptr, dtype=vec3, shape=(entries,), strides=strides, device=device, copy=False)
    roots._owner = packed_roots  # whose memory it is
    # Warp's own way would spread the gradient like the array; kernels have it side by side.
    roots._grad = wp.zeros(entries, dtype=vec3, device=device) if requires_grad else None
    return ProjectedArrays(empty(vec2), empty(dtype), roots, empty(dtype), visible, extents, packed_roots)


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

    Raises:
        ValueError: if ``settings`` or the number of images ask for what this shortcut does not do, or the numbers in
            ``settings`` are not those of the arrays.
    """
    images = len(gaussians.viewmats)
    if settings.antialiased or images != 1:
        raise ValueError("rasterize() renders one image in the classic mode; chain the four steps for anything else.")
    # What settings say is what kernels read and write, of memory that is not there too.
    counts, there = (settings.num_gaussians, settings.num_cameras, settings.num_images), len(gaussians.means)
    if counts != (there, 1, 1) or len(features) != there:
        raise ValueError(
            f"settings must have num_gaussians = {there} (the means), num_cameras = num_images = 1, got {counts}; "
            f"features must have {there} rows, got {len(features)}."
        )
    device, dtype = gaussians.means.device, gaussians.opacities.dtype
    projected = allocate_projected(images * settings.num_gaussians, dtype, device, tape is not None)
    project_gaussians(gaussians, settings, projected, tape)
    shape = (images * settings.height, settings.width)

    def image(kind: type) -> wp.array:
        return wp.empty(shape, dtype=kind, device=device, requires_grad=tape is not None and kind is not wp.int32)

    blended = BlendedArrays(image(features.dtype), image(dtype), image(wp.int32))
    if thermal_channels:
        blended.thermal_render = image(wp.types.vector(thermal_channels, dtype))
        blended.thermal_transmittance, blended.thermal_ends = image(dtype), image(wp.int32)
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
