"""Projected Gaussians on their way to the ranks that blend them, and their gradients on the way back.

Every rank projects its own Gaussians to the cameras of all ranks. Those that a camera sees go to the camera's rank by
one all-to-all, the scheme of Grendel (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 3) and
of gsplat's ``distributed=True``. So a rank holds the projections of what its own cameras see, and of the other
Gaussians nothing.

Notation: W ranks with C_world cameras together, in the order of ranks; N Gaussians on this rank, which seen from all
cameras have C_world · N rows; this rank has C cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.distributed.collectives import exchanged_rows, tensors_of_all


@dataclass(frozen=True)
class Route:
    """Which rows go where."""

    rows: Tensor
    """int64 [n], the rows that this rank sends: those that some camera sees, camera by camera. With a room, what is
    left of each camera's is the row after the last: a row of zeros, which no camera sees."""
    sent: list[int]
    """Rows for each rank."""
    received: list[int]
    """Rows from each rank."""
    places: Tensor | None
    """int64 [m], where what arrives goes: camera by camera, each with room for ``seen`` rows. None: as it arrives."""
    seen: int
    """Most Gaussians that a camera of this rank sees, or there is room for."""
    has_room: bool = False
    """Whether rows may be missing."""


def route_of_seen(visible: Tensor, cameras: Sequence[int]) -> Route:
    """The route of the Gaussians that cameras see. Waits for the device.

    Args:
        visible: bool [C_world, N].
        cameras: Cameras of each rank.
    """
    rank, starts = dist.get_rank(), [0, *accumulate(cameras)]
    counts = [of_rank.tolist() for of_rank in tensors_of_all(visible.sum(dim=1))]  # [W][C_world]
    first, beyond = starts[rank], starts[rank + 1]
    sent = [sum(counts[rank][start:stop]) for start, stop in pairwise(starts)]
    arriving = [of_rank[first:beyond] for of_rank in counts]  # [W][C]
    totals = [sum(of_camera) for of_camera in zip(*arriving, strict=True)]
    seen = max(totals, default=0)
    places = None
    if beyond - first > 1:
        filled, ranges = [camera * seen for camera in range(beyond - first)], []
        for of_rank in arriving:
            for camera, count in enumerate(of_rank):
                ranges.append(torch.arange(filled[camera], filled[camera] + count, device=visible.device))
                filled[camera] += count
        places = torch.cat(ranges)
    rows = visible.flatten().nonzero().squeeze(1)
    return Route(rows, sent, [sum(of_rank) for of_rank in arriving], places, seen)


def route_in_room(visible: Tensor, cameras: Sequence[int], room: int) -> Route:
    """The route of the Gaussians that cameras see, with so much room whatever they see. The device is not waited for.

    What finds no room is left out: the last ones of this rank.

    Args:
        visible: bool [C_world, N].
        cameras: Cameras of each rank.
        room: Gaussians of a rank before a camera; the same number on every rank.
    """
    world, ranks, own = len(visible), len(cameras), cameras[dist.get_rank()]
    places = visible.cumsum(dim=1) - 1
    places = torch.where(visible & (places < room), places, room)
    every = torch.arange(visible.numel(), device=visible.device).view(visible.shape)
    # what has no place is written behind the room, and cut off
    rows = torch.full((world, room + 1), visible.numel(), device=visible.device).scatter_(1, places, every)
    arrived = torch.arange(own * ranks * room, device=visible.device).view(own, ranks, room)
    return Route(
        rows[:, :room].flatten(),
        [room * count for count in cameras],
        [room * own] * ranks,
        arrived.transpose(0, 1).flatten() if own > 1 else None,
        ranks * room,
        has_room=True,
    )


@dataclass
class AbsoluteGradients:
    """Sums of absolute gradients, which no autograd graph carries: they travel beside the gradients."""

    shown: Tensor
    """The owner's tensor, [C_world, N, 2], whose ``absgrad`` they become."""
    received: Tensor = field(default_factory=lambda: torch.empty(0))
    """Stands for the received positions: what blends them sets its ``absgrad``."""
    wanted: bool = False


class Exchange(torch.autograd.Function):
    """Sends rows to the ranks that need them; gradients go the same way back."""

    @staticmethod
    def forward(
        ctx: Any, route: Route, cameras: int, absolute: AbsoluteGradients, num_carried: int, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        """What arrives, each [C · seen, width]; rows that nothing arrives for are zero.

        Args:
            ctx: What the backward pass reads.
            route: Which rows go where.
            cameras: C.
            absolute: Sums that travel back with the gradients.
            num_carried: The last tensors, so many, get no gradient.
            *tensors: [C_world · N, width] each, of one dtype.
        """
        ctx.route, ctx.absolute = route, absolute
        ctx.shapes = [tensor.shape for tensor in tensors]
        ctx.num_carried = num_carried
        ctx.set_materialize_grads(False)
        sent = _sent(route, tensors)
        arrived = exchanged_rows(sent, route.sent, route.received)
        if route.places is not None:
            placed = arrived.new_zeros(cameras * route.seen, arrived.shape[1])
            arrived = placed.index_copy_(0, route.places, arrived)
        parts = [part.contiguous() for part in arrived.split([tensor.shape[1] for tensor in tensors], dim=1)]
        ctx.mark_non_differentiable(*parts[len(parts) - num_carried :])
        return tuple(parts)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        """Gradients to the rows, where they came from."""
        route, absolute = ctx.route, ctx.absolute
        shapes, given = ctx.shapes[: -ctx.num_carried or None], list(gradients[: -ctx.num_carried or None])
        like, rows = absolute.shown, sum(route.received)
        if absolute.wanted:
            shapes = [*shapes, (absolute.shown.numel() // 2, 2)]
            of_positions = getattr(absolute.received, "absgrad", None)
            given.append(None if of_positions is None else of_positions.reshape(-1, 2))
            if of_positions is not None:
                del absolute.received.absgrad  # sent; another backward pass through the same graph adds its own
        columns = [
            like.new_zeros(rows, shape[1])
            if gradient is None
            else (gradient if route.places is None else gradient.index_select(0, route.places))
            for gradient, shape in zip(given, shapes, strict=True)
        ]
        returned = exchanged_rows(torch.cat(columns, dim=1), route.received, route.sent)
        found = [
            like.new_zeros(shape[0] + route.has_room, shape[1]).index_copy_(0, route.rows, part)[: shape[0]]
            for shape, part in zip(shapes, returned.split([shape[1] for shape in shapes], dim=1), strict=True)
        ]
        if absolute.wanted:
            total = found.pop().reshape(absolute.shown.shape)
            earlier = getattr(absolute.shown, "absgrad", None)
            absolute.shown.absgrad = total if earlier is None else earlier + total
        return None, None, None, None, *found, *(None for _ in range(ctx.num_carried))


def _sent(route: Route, tensors: Sequence[Tensor]) -> Tensor:
    """The rows that this rank sends, all tensors side by side."""
    if not route.has_room:
        return torch.cat([tensor.index_select(0, route.rows) for tensor in tensors], dim=1)
    count = len(tensors[0])
    rows = route.rows.clamp(max=max(count - 1, 0))
    given = tensors if count > 0 else [tensor.new_zeros(1, tensor.shape[1]) for tensor in tensors]
    sent = torch.cat([tensor.index_select(0, rows) for tensor in given], dim=1)
    return sent.masked_fill_((route.rows == count)[:, None], 0.0)
