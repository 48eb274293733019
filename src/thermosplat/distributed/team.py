"""The ranks that train one scene: who this process is among them, and what it may ask of all.

A team of W ranks divides N rows (Gaussians) into consecutive blocks of equal size, but for one row: rank 0 has the
first. Every method is to be called by all ranks, in the same order. A team of one exchanges nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from thermosplat.distributed.collectives import exchanged_rows, numbers_of_all

Answer = TypeVar("Answer")


class EndedElsewhere(BaseException):
    """Another rank failed and says so: this one ends quietly."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Another rank ended with code {code}.")
        self.code = code


def blocks(rows: int, ranks: int) -> list[int]:
    """Rows of each rank."""
    return [rows // ranks + (1 if rank < rows % ranks else 0) for rank in range(ranks)]


@dataclass(frozen=True)
class Team:
    """The ranks, as one of them sees them."""

    rank: int
    size: int
    device: torch.device
    """Where this rank's Gaussians are."""

    @classmethod
    def of_one(cls, device: torch.device) -> "Team":
        """This process alone."""
        return cls(0, 1, device)

    @property
    def is_alone(self) -> bool:
        """Whether there is one rank, which tells nobody anything."""
        return self.size == 1

    @property
    def is_first(self) -> bool:
        """Whether this rank speaks and writes for all."""
        return self.rank == 0

    def numbers(self, numbers: Sequence[int]) -> list[list[int]]:
        """Every rank's numbers, as many on each. The device is not waited for."""
        if self.is_alone:
            return [list(map(int, numbers))]
        return [[int(number) for number in of_rank] for of_rank in numbers_of_all(numbers, self.device)]

    def all_can(self, can: bool) -> bool:
        """Whether all ranks can do something that this one can, or cannot."""
        return all(number for (number,) in self.numbers([can]))

    def block_of(self, rows: int) -> slice:
        """This rank's rows of so many."""
        counts = blocks(rows, self.size)
        start = sum(counts[: self.rank])
        return slice(start, start + counts[self.rank])

    def sum_in_place(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their sums over all ranks."""
        if not self.is_alone:
            _reduce_in_place(tensors, dist.ReduceOp.SUM)

    def largest_in_place(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their largest values over all ranks."""
        if not self.is_alone:
            _reduce_in_place(tensors, dist.ReduceOp.MAX)

    def on_first(self, rows: Tensor, counts: Sequence[int]) -> Tensor | None:
        """Every rank's rows [n, ...], one below the other, on rank 0; None on the others.

        Args:
            counts: Rows of each rank.
        """
        sent = [len(rows) if rank == 0 else 0 for rank in range(self.size)]
        received = list(counts) if self.is_first else [0] * self.size
        everything = exchanged_rows(_flat(rows).to(self.device), sent, received)
        return everything.reshape(sum(counts), *rows.shape[1:]) if self.is_first else None

    def from_first(self, rows: Tensor | None, like: Tensor, total: int) -> Tensor:
        """This rank's block of rows that rank 0 has.

        Args:
            rows: On rank 0 all of them, [total, ...]; None on the others.
            like: A tensor of their type and of the shape [n, ...].
        """
        counts = blocks(total, self.size)
        width = like.shape[1:].numel()
        given = like.new_empty(0, width) if rows is None else rows.reshape(total, width).to(like.dtype)
        received = [counts[self.rank] if rank == 0 else 0 for rank in range(self.size)]
        sent = counts if self.is_first else [0] * self.size
        block = exchanged_rows(given.to(self.device), sent, received)
        return block.reshape(counts[self.rank], *like.shape[1:])

    def objects(self, own: Any) -> list[Any]:
        """Every rank's object, by rank."""
        if self.is_alone:
            return [own]
        gathered: list[Any] = [None] * self.size
        dist.all_gather_object(gathered, own)
        return gathered

    def object_of_first(self, own: Any = None) -> Any:
        """Rank 0's object."""
        if self.is_alone:
            return own
        held = [own]
        dist.broadcast_object_list(held, src=0, device=torch.device("cpu"))
        return held[0]

    def dealt(self, objects: Sequence[Any] | None) -> Any:
        """This rank's of the objects, one for each rank, that rank 0 has."""
        if self.is_alone and objects is not None:
            return objects[0]
        own: list[Any] = [None]
        dist.scatter_object_list(own, None if objects is None else list(objects), src=0)
        return own[0]

    def asked_of_first(self, question: Callable[[], Answer]) -> Answer:
        """What rank 0 answers; others do not ask. Where that fails it fails on rank 0, and the others end.

        Raises:
            EndedElsewhere: On the other ranks, where rank 0 failed.
        """
        answer: Any = None
        try:
            if self.is_first:
                answer = question()
        except BaseException as error:
            self.object_of_first((False, _exit_code(error)))
            raise
        succeeded, value = self.object_of_first((True, answer))
        if not succeeded:
            raise EndedElsewhere(value)
        return value

    def done_by_all(self, work: Callable[[], Answer]) -> Answer:
        """What this rank's work gives; where it fails on some, the first of them fails and the others end.

        Raises:
            EndedElsewhere: Where another rank says what went wrong.
        """
        failure: BaseException | None = None
        answer: Any = None
        try:
            answer = work()
        except BaseException as error:
            failure = error
        codes = self.objects(None if failure is None else _exit_code(failure))
        failed = [rank for rank, code in enumerate(codes) if code is not None]
        if not failed:
            return answer
        if failure is not None and failed[0] == self.rank:
            raise failure
        raise EndedElsewhere(codes[failed[0]])


def _reduce_in_place(tensors: Sequence[Tensor], operation: Any) -> None:
    """One reduction of all tensors, which have one dtype."""
    if not tensors:
        return
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
    dist.all_reduce(flat, op=operation)
    for tensor, found in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(found.view(tensor.shape))


def _exit_code(error: BaseException) -> int:
    code = getattr(error, "code", 2)
    return code if isinstance(code, int) else 2


@dataclass(frozen=True)
class RowFetch:
    """A way of rows from the ranks that have them to the ranks that asked."""

    asked_order: Tensor
    """int64 [n], the place among the asked rows of each row that arrives."""
    arriving: list[int]
    """Rows that come from each rank."""
    lent: Tensor
    """int64 [m], rows of this rank that others asked for, by rank."""
    leaving: list[int]
    """Rows that go to each rank."""

    def of(self, rows: Tensor) -> Tensor:
        """The asked rows of a tensor whose rows are divided, [n, ...]; this rank's are given, [N_k, ...]."""
        arrived = exchanged_rows(_flat(rows).index_select(0, self.lent), self.leaving, self.arriving)
        asked = torch.empty_like(arrived).index_copy_(0, self.asked_order, arrived)
        return asked.reshape(len(self.asked_order), *rows.shape[1:])


def _flat(rows: Tensor) -> Tensor:
    """Rows [n, ...] as [n, X], whatever n and X are."""
    return rows.reshape(len(rows), rows.shape[1:].numel())


def row_fetch(team: Team, counts: Sequence[int], rows: Tensor) -> RowFetch:
    """Ask for rows of divided tensors. Waits for the device.

    Args:
        counts: Rows that each rank has.
        rows: int64 [n], which this rank asks for, counted over all ranks.
    """
    starts = torch.tensor([0, *accumulate(counts)], device=rows.device)
    owners = torch.searchsorted(starts, rows, right=True) - 1
    order = owners.argsort(stable=True)
    arriving = torch.bincount(owners, minlength=team.size).tolist()
    leaving = [asked[team.rank] for asked in team.numbers(arriving)]
    local = (rows - starts[owners])[order]
    return RowFetch(order, arriving, exchanged_rows(local, arriving, leaving), leaving)
