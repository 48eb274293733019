"""Projected Gaussians on their way to the ranks that blend them, and their gradients on the way back.

Every rank projects its own Gaussians to the cameras of all ranks. Those that a camera sees go to the camera's rank by
one all-to-all, the scheme of Grendel (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 3) and
of gsplat's ``distributed=True``. So a rank holds the projections of what its own cameras see, and of the other
Gaussians nothing.

What travels from a rank to a camera is one block, in which one tensor's rows follow another's. So rows are gathered
straight into what is sent, and what arrives is copied whole. Rows for this rank's own cameras do not travel.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.distributed.collectives import exchanged_rows
from thermosplat.rasterizer.row_routes import Route
from thermosplat.torch_bridge.arrays import strided_view, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.projection.row_copies import gather_rows


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
        ctx: Any,
        route: Route,
        absolute: AbsoluteGradients,
        num_carried: int,
        wider: Mapping[int, Tensor],
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        """What arrives, each [C · seen, width]; rows that nothing arrives for are zero.

        Args:
            absolute: Sums that travel back with the gradients.
            num_carried: The last tensors, so many, get no gradient.
            wider: By the number of a tensor, the table whose first columns it is, [C_world · N, width + more]. All of
                its columns travel. What arrives of them comes behind the tensors, in the order of their numbers.
            *tensors: [C_world · N, width] each, of one dtype.
        """
        ctx.route, ctx.absolute = route, absolute
        ctx.shapes = [tensor.shape for tensor in tensors]
        ctx.num_carried = num_carried
        ctx.set_materialize_grads(False)
        make = tensors[0].new_empty if route.is_full else tensors[0].new_zeros
        tables = [wider.get(i, tensor) for i, tensor in enumerate(tensors)]
        widths = [table.shape[1] for table in tables]
        parts = [make((route.num_places, width)) for width in widths]
        outgoing = parts[0].new_empty(sum(_numbers_of(route.sent, route.rank, widths)))
        leaving = _Blocks(outgoing, widths)
        here = (places for rank, places in route.arrivals() if rank == route.rank)
        for rank, numbers, _ in route.departures():
            block = _rows(parts, next(here)) if rank == route.rank else leaving.next(len(numbers))
            _gather(numbers, tables, block)
        arriving = _Blocks(_exchanged(outgoing, route.sent, route.received, route.rank, widths), widths)
        for rank, places in route.arrivals():
            if rank != route.rank:
                torch._foreach_copy_(_rows(parts, places), arriving.next(places.stop - places.start))
        received = list(parts)
        for i in wider:
            received[i] = parts[i][:, : tensors[i].shape[1]]
        whole = [parts[i] for i in sorted(wider)]
        ctx.mark_non_differentiable(*received[len(parts) - num_carried :], *whole)
        return *received, *whole

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        """Gradients to the rows, where they came from."""
        route, absolute = ctx.route, ctx.absolute
        shapes = ctx.shapes[: len(ctx.shapes) - ctx.num_carried]
        given = list(gradients[: len(shapes)])
        like = absolute.shown
        if absolute.wanted:
            shapes = [*shapes, (absolute.shown.numel() // 2, 2)]
            of_positions = getattr(absolute.received, "absgrad", None)
            given.append(None if of_positions is None else of_positions.reshape(-1, 2))
            if of_positions is not None:
                del absolute.received.absgrad  # sent; another backward pass through the same graph adds its own
        widths = [shape[1] for shape in shapes]
        v_parts = [
            like.new_zeros(route.num_places, width) if gradient is None else gradient
            for gradient, width in zip(given, widths, strict=True)
        ]
        outgoing = like.new_empty(sum(_numbers_of(route.received, route.rank, widths)))
        leaving = _Blocks(outgoing, widths)
        for rank, places in route.arrivals():
            if rank != route.rank:
                torch._foreach_copy_(leaving.next(places.stop - places.start), _rows(v_parts, places))
        arriving = _Blocks(_exchanged(outgoing, route.received, route.sent, route.rank, widths), widths)
        found = [like.new_empty(shape) for shape in shapes]
        here = (places for rank, places in route.arrivals() if rank == route.rank)
        for camera, (rank, numbers, places) in enumerate(route.departures()):
            block = _rows(v_parts, next(here)) if rank == route.rank else arriving.next(len(numbers))
            of_camera = slice(camera * len(places), (camera + 1) * len(places))
            _gather(places, block, _rows(found, of_camera))
        if absolute.wanted:
            total = found.pop().reshape(absolute.shown.shape)
            earlier = getattr(absolute.shown, "absgrad", None)
            absolute.shown.absgrad = total if earlier is None else earlier + total
        return None, None, None, None, *found, *(None for _ in range(ctx.num_carried))


class _Blocks:
    """The blocks of a buffer, from its beginning on.

    Args:
        buffer: [numbers].
        widths: Numbers in a row of each tensor.
    """

    def __init__(self, buffer: Tensor, widths: Sequence[int]) -> None:
        self._buffer, self._widths, self._start = buffer, widths, 0

    def next(self, rows: int) -> list[Tensor]:
        """The next block: [rows, width] of each tensor."""
        return list(self._parts(rows))

    def _parts(self, rows: int) -> Iterator[Tensor]:
        for width in self._widths:
            beyond = self._start + rows * width
            yield self._buffer[self._start : beyond].view(rows, width)
            self._start = beyond


def _numbers_of(rows: Sequence[Sequence[int]], own: int, widths: Sequence[int]) -> list[int]:
    """Numbers that travel to or from each rank; none of this one."""
    return [0 if rank == own else sum(of_rank) * sum(widths) for rank, of_rank in enumerate(rows)]


def _exchanged(
    outgoing: Tensor, sent: Sequence[Sequence[int]], received: Sequence[Sequence[int]], own: int, widths: Sequence[int]
) -> Tensor:
    """What the other ranks send this one, [numbers]."""
    if len(sent) == 1:
        return outgoing
    return exchanged_rows(outgoing, _numbers_of(sent, own, widths), _numbers_of(received, own, widths))


def _rows(tensors: Sequence[Tensor], places: slice) -> list[Tensor]:
    """These rows of each tensor."""
    return [tensor[places] for tensor in tensors]


def _gather(numbers: Tensor, tables: Sequence[Tensor], targets: Sequence[Tensor]) -> None:
    """Write rows of tables, [n, width] of each."""
    with launches_on_torch_stream(numbers.device):
        for table, target in zip(tables, targets, strict=True):
            gather_rows(view(numbers, wp.int32), strided_view(table.detach()), strided_view(target))
