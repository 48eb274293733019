"""The lists of Gaussians a tile, made in torch's memory, and who keeps that memory alive."""

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import joined_capture, on_torch_stream
from warp_kernels.binning import binning_step
from warp_kernels.binning.tile_bins import Room, TileBins
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings


class TileLists(NamedTuple):
    """The lists, and the memory they lie in."""

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


_CAPTURED_WITHOUT_ROOM = (
    "A CUDA graph cannot capture a rasterization that reads its number of (Gaussian, tile) pairs back.",
    "Give it room for them beforehand with thermosplat.PairCapacity, whose documentation has an example.",
)
_READ = ("gaussian_ids", "tile_offsets")
_READ_BY_SLOT = (*_READ, "slots", "order", "pair_ends")


def tile_lists(
    projected: ProjectedArrays,
    opacities: Tensor,
    thermal_opacities: Tensor,
    features: Tensor,
    settings: ProjectionSettings,
    tile_size: int,
    rest: Tensor | None = None,
    room: Room | None = None,
    *,
    deterministic: bool = False,
    note: Callable[[Tensor], None] | None = None,
) -> TileLists:
    """Lists the Gaussians of each tile.

    Args:
        projected: what ``Project`` returned; Gaussians with non-finite features become invisible, in place.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same tensor where there is one opacity.
        features: [images · N, D].
        settings: image size.
        tile_size: edge of a tile [px].
        rest: [images · N, D'], channels that lie apart from those; None: there are no others.
        room: of the lists; None: the number of pairs is read back from the device.
        deterministic: number the pairs, so that the adjoint sums in the same order every time; always on the CPU.
        note: told how many pairs there are (``PairCapacity.note``) before they are listed.

    Returns:
        The lists.

    Raises:
        UserError: if a CUDA graph is captured without a ``room``, or there are too many pairs to number.
    """
    scalar = kinds_of(opacities.dtype).scalar
    scalar_views = view(opacities, scalar), view(thermal_opacities, scalar)
    with on_torch_stream(opacities.device) as device:
        try:
            with joined_capture(opacities.device) as captured:
                if captured and room is None:
                    raise UserError(*_CAPTURED_WITHOUT_ROOM)
                nearest_first = binning_step.sort_gaussians(
                    projected,
                    *scalar_views,
                    view(features, scalar, *features.shape),
                    settings,
                    tile_size,
                    rest=None if rest is None else view(rest, scalar, *rest.shape),
                    room=room,
                )
            if note is not None:  # outside of both: whoever is told may end a capture here, and begin the next
                totals, ends = nearest_first.totals, nearest_first.pair_ends
                note(ends.owner[-1:] if totals is None else totals.owner[-1])
            by_slot = deterministic or not device.is_cuda
            with joined_capture(opacities.device):
                bins = binning_step.list_pairs(projected, *scalar_views, nearest_first, by_slot=by_slot, room=room)
        except binning_step.TooManyPairsError as error:
            raise UserError(str(error), "Render fewer cameras per call, a smaller image, or smaller scales.") from error
    tensors: dict[str, Tensor] = {}
    for name, array in vars(bins).items():
        if type(array) is ArrayView:
            tensors[name], array.owner = array.owner, None
    return TileLists(bins, tensors)
