"""Which projected Gaussians go to which rank's cameras.

Notation: W ranks with C_world cameras together, in the order of ranks; N Gaussians on this rank, which seen from all
cameras have C_world · N rows; this rank has C cameras.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from thermosplat.distributed.collectives import tensors_of_all


class Departure(NamedTuple):
    """Rows that leave for a camera."""

    rank: int
    """The camera's."""
    numbers: Tensor
    """int64 [n], which of this rank's C_world · N rows. C_world · N itself: none, a row of zeros goes in its place."""


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
    """This one."""
    numbers: Tensor
    """int64 [n], the rows that this rank sends, camera by camera. See ``Departure``."""
    sent: list[list[int]]
    """Rows for each camera of each rank."""
    received: list[list[int]]
    """Rows from each rank for each of this rank's cameras."""
    seen: int
    """Most Gaussians that a camera of this rank sees, or there is room for."""

    def departures(self) -> Iterator[Departure]:
        """What leaves, in the order of ranks and their cameras; this rank's own, too."""
        start = 0
        for rank, counts in enumerate(self.sent):
            for count in counts:
                yield Departure(rank, self.numbers[start : start + count])
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
        cameras: Cameras of each rank.
    """
    rank, edges = dist.get_rank(), list(pairwise([0, *accumulate(cameras)]))
    counts = [of_rank.tolist() for of_rank in tensors_of_all(visible.sum(dim=1))]  # [W][C_world]
    sent = [counts[rank][first:beyond] for first, beyond in edges]
    first, beyond = edges[rank]
    received = [of_rank[first:beyond] for of_rank in counts]
    seen = max((sum(of_camera) for of_camera in zip(*received, strict=True)), default=0)
    return Route(rank, visible.flatten().nonzero().squeeze(1), sent, received, seen)


def route_in_room(visible: Tensor, cameras: Sequence[int], room: int) -> Route:
    """The route of the Gaussians that cameras see, with so much room whatever they see. The device is not waited for.

    What finds no room is left out: the last ones of this rank.

    Args:
        visible: bool [C_world, N].
        cameras: Cameras of each rank.
        room: Gaussians of a rank before a camera; the same number on every rank.
    """
    rank = dist.get_rank()
    counts = visible.sum(dim=1)
    before = counts.cumsum(0) - counts
    # summed as one long row: torch gives each row of a matrix to one block of threads
    until = visible.flatten().cumsum(0).view(visible.shape)
    places = until - before[:, None] - 1
    places = torch.where(visible & (places < room), places, room)
    every = torch.arange(visible.numel(), device=visible.device).view(visible.shape)
    # what has no place is written behind the room, and cut off
    numbers = torch.full((len(visible), room + 1), visible.numel(), device=visible.device).scatter_(1, places, every)
    sent, received = [[room] * count for count in cameras], [[room] * cameras[rank] for _ in cameras]
    return Route(rank, numbers[:, :room].flatten(), sent, received, len(cameras) * room)
