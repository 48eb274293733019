"""The lists of Gaussians a tile, made in torch's memory, and who keeps that memory alive."""

from dataclasses import replace

from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.warp_bridge import kinds_of, view
from thermosplat.warp_streams import joined_capture, on_torch_stream
from warp_kernels import binning_step
from warp_kernels.array_views import ArrayView
from warp_kernels.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.tile_binning import TileBins


def bin_tiles(
    projected: ProjectedArrays,
    opacities: Tensor,
    thermal_opacities: Tensor,
    features: Tensor,
    settings: ProjectionSettings,
    tile_size: int,
    rest: Tensor | None = None,
    capacity: int | None = None,
    room: int | None = None,
    *,
    deterministic: bool = False,
) -> TileBins:
    """Lists the Gaussians of each tile.

    Args:
        projected: what ``Project`` returned; radii of Gaussians with non-finite features become zero, in place.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same tensor where there is one opacity.
        features: [images · N, D].
        settings: image size.
        tile_size: edge of a tile [px].
        rest: [images · N, D'], channels that lie apart from those; None: there are no others.
        capacity: pairs there is room for; None: their number is read back from the device.
        room: with ``capacity``, Gaussians with pairs there is room for; None: for all.
        deterministic: number the pairs, so that the adjoint sums in the same order every time; always on the CPU.

    Returns:
        The bins.

    Raises:
        UserError: if a CUDA graph is captured without ``capacity``, or there are too many pairs to number.
    """
    scalar = kinds_of(opacities.dtype).scalar
    with on_torch_stream(opacities.device) as device, joined_capture(opacities.device) as captured:
        if captured and capacity is None:
            raise UserError(
                "A CUDA graph cannot capture a rasterization that reads its number of (Gaussian, tile) pairs back.",
                "Give it room for them beforehand with thermosplat.PairCapacity, whose documentation has an example.",
            )
        try:
            return binning_step.bin_tiles(
                projected,
                view(opacities, scalar),
                view(thermal_opacities, scalar),
                view(features, scalar, *features.shape),
                settings,
                tile_size,
                by_slot=deterministic or not device.is_cuda,
                rest=None if rest is None else view(rest, scalar, *rest.shape),
                capacity=capacity,
                room=room,
            )
        except binning_step.TooManyPairsError as error:
            raise UserError(str(error), "Render fewer cameras per call, a smaller image, or smaller scales.") from error


def read_by_adjoint(bins: TileBins) -> TileBins:
    """The lists without those that only binning needed.

    Args:
        bins: from ``bin_tiles``.

    Returns:
        What the blending's adjoint reads.
    """
    if bins.slots is not None:
        return replace(bins, totals=None)
    return replace(bins, totals=None, order=None, pair_ends=None)


def unowned(bins: TileBins) -> TileBins:
    """The same lists, as arrays that do not keep their memory alive.

    Args:
        bins: any.

    Returns:
        The lists; see ``owners``.
    """
    arrays = {name: value.unowned() for name, value in vars(bins).items() if isinstance(value, ArrayView)}
    return TileBins(**vars(bins) | arrays)


def owners(bins: TileBins) -> list[Tensor]:
    """What the lists' memory belongs to.

    Args:
        bins: any, but ``unowned`` ones.

    Returns:
        The tensors.
    """
    return [array.owner for array in views(bins)]


def views(bins: TileBins) -> list[ArrayView]:
    """The lists' arrays.

    Args:
        bins: any.

    Returns:
        The arrays, in the order of ``owners``.
    """
    return [value for value in vars(bins).values() if isinstance(value, ArrayView)]
