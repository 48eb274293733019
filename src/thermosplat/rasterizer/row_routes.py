"""Which projected Gaussians go to which rank's cameras.

Notation: W ranks with C_world cameras together, in the order of ranks; N Gaussians on this rank, which seen from all
cameras have C_world · N rows, fewer than 2^31; this rank has C cameras.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
import torch.distributed as dist
import warp as wp
from torch import Tensor

from thermosplat.distributed.collectives import tensors_of_all
from thermosplat.torch_bridge.arrays import view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.projection.row_copies import place_rows


class Departure(NamedTuple):
    """Rows that leave for a camera."""

    rank: int
    numbers: Tensor
    """int32 [n], which of this rank's C_world · N rows. -1: none, a row of zeros goes in its place."""
    places: Tensor
    """int32 [N], which of those n each of this rank's Gaussians is; -1: it does not leave."""


class Arrival(NamedTuple):
    """Rows of a rank that arrive for one of this rank's cameras."""

    rank: int
    """Where they come from."""
    places: slice
    """Where they go among C · ``Route.seen`` rows."""


@dataclass(frozen=True)
class Route:
    """Which rows go where."""

    rank: int
    numbers: Tensor
    """int32 [n], the rows that this rank sends, camera by camera. See ``Departure``."""
    places: Tensor
    """int32 [C_world, N], where each of its rows is among those of its camera. See ``Departure``."""
    sent: list[list[int]]
    """Rows for each camera of each rank."""
    received: list[list[int]]
    """Rows from each rank for each of this rank's cameras."""
    seen: int
    """Most Gaussians that a camera of this rank sees, or there is room for."""

    def departures(self) -> Iterator[Departure]:
        """What leaves, in the order of ranks and their cameras; this rank's own, too."""
        start, places = 0, iter(self.places)
        for rank, counts in enumerate(self.sent):
            for count in counts:
                yield Departure(rank, self.numbers[start : start + count], next(places))
                start += count

    def arrivals(self) -> Iterator[Arrival]:
        """What arrives, in the order of ranks and this rank's cameras; its own, too."""
        filled = [camera * self.seen for camera in range(len(self.received[self.rank]))]
        for rank, counts in enumerate(self.received):
            for camera, count in enumerate(counts):
                yield Arrival(rank, slice(filled[camera], filled[camera] + count))
                filled[camera] += count

    @property
    def num_places(self) -> int:
        """C · ``seen``."""
        return len(self.received[self.rank]) * self.seen

    @property
    def is_full(self) -> bool:
        """Whether a row arrives for every place."""
        return sum(map(sum, self.received)) == self.num_places


def route_of_seen(visible: Tensor, cameras: Sequence[int]) -> Route:
    """The route of the Gaussians that cameras see. Waits for the device.

    Args:
        visible: bool [C_world, N].
    """
    rank, edges = dist.get_rank(), list(pairwise([0, *accumulate(cameras)]))
    counts = [of_rank.tolist() for of_rank in tensors_of_all(visible.sum(dim=1))]  # [W][C_world]
    sent = [counts[rank][first:beyond] for first, beyond in edges]
    first, beyond = edges[rank]
    received = [of_rank[first:beyond] for of_rank in counts]
    seen = max((sum(of_camera) for of_camera in zip(*received, strict=True)), default=0)
    numbers = visible.flatten().nonzero().squeeze(1).int()
    places = torch.where(visible, visible.cumsum(dim=1, dtype=torch.int32) - 1, -1)
    return Route(rank, numbers, places, sent, received, seen)


def route_in_room(visible: Tensor, cameras: Sequence[int], room: int) -> Route:
    """The route of the Gaussians that cameras see, with so much room whatever they see. The device is not waited for.

    What finds no room is left out: the last ones of this rank.

    Args:
        visible: bool [C_world, N].
        room: Gaussians of a rank before a camera; the same number on every rank.
    """
    rank = dist.get_rank()
    # summed as one long row: torch gives each row of a matrix to one block of threads
    until = visible.flatten().cumsum(0, dtype=torch.int32)
    numbers = until.new_full((len(visible) * room,), -1)
    places = torch.empty_like(until)
    with launches_on_torch_stream(until.device):
        arrays = (view(tensor, wp.int32) for tensor in (numbers, places))
        place_rows(view(until, wp.int32), visible.shape[1], room, *arrays)
    sent, received = [[room] * count for count in cameras], [[room] * cameras[rank] for _ in cameras]
    return Route(rank, numbers, places.view(visible.shape), sent, received, len(cameras) * room)
