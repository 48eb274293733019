"""Room for the (Gaussian, tile) pairs of a step known beforehand, so that no rasterization waits for the device.

A rasterization reads the numbers of its pairs and of the Gaussians that have any back to the host, to allocate what
they need. A step that is captured in a CUDA graph cannot: it gets a fixed room instead, measured on the steps before,
and says on the device what did not fit.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.pair_notes import note_totals
from warp_kernels.binning.tile_bins import Room

CALLS = 8
"""Most rasterizations in a step."""

SPARE = 1.5
"""Room over the most pairs seen; between two measurements (100 steps) Gaussians grow in number and opacity."""

LEAST = 1024
"""Pairs there is always room for."""

_active: "ContextVar[PairCapacity | None]" = ContextVar("active pair capacity", default=None)


class PairCapacity:
    """How many pairs each rasterization of a step had, and how many the next ones have room for.

    With a fixed room ``rasterization`` and ``rasterization_rgbt`` never wait for the device, forward or backward, and
    can be captured with ``torch.cuda.graph`` or ``torch.cuda.make_graphed_callables``. Measure on the views that will
    be rendered, forward and backward, with the options of later: that also compiles and loads the kernels, which cannot
    be captured. Pairs that find no room, most of them of the farthest Gaussians, are not drawn and get no gradient;
    ``overflow`` and :meth:`check` tell. A step may have up to ``CALLS`` = 8 rasterizations; one more raises a
    ``UserError`` (several cameras in one call count as one).

    Args:
        device: Where the renderer runs.
        spare: Room over the most pairs seen, as a factor, 1.5 by default; what is not used costs memory and sorting.

    Attributes:
        most: int64 [CALLS], most pairs of each call of a step so far.
        most_listed: int64 [CALLS], most Gaussians with pairs; 0 where that was not counted, as there were few.
        overflow: float32 scalar on the device, 1 where a call of the last step (or replay) had more pairs, or rows for
            other ranks, than room.
        spare: as given; the next :meth:`measure` makes room by it.
        most_rows: int64 [CALLS], most Gaussians of this rank that a camera saw, of calls with ``distributed=True``.

    Where calls are ``distributed=True``, every rank calls :meth:`measure` at the same time.

    Example:
        >>> capacity = PairCapacity("cuda")                                    # doctest: +SKIP
        >>> for view in views:
        ...     with capacity.step(fixed=False):
        ...         loss(rasterization(**gaussians, **view)[0]).backward()     # warms up, and counts pairs
        >>> capacity.measure()
        >>> graph = torch.cuda.CUDAGraph()
        >>> with torch.cuda.graph(graph), capacity.step(fixed=True):
        ...     image, alphas, info = rasterization(**gaussians, **view)
        ...     loss(image).backward()
        >>> view["viewmats"].copy_(another)
        >>> graph.replay()                                                     # image and .grad are of the other view
        >>> capacity.check()                                                   # now and then: it waits for the device
    """

    def __init__(self, device: torch.device | str, spare: float = SPARE) -> None:
        self.most = torch.zeros(CALLS, dtype=torch.int64, device=device)
        self.most_listed = torch.zeros_like(self.most)
        self.most_rows = torch.zeros_like(self.most)
        self.overflow = torch.zeros((), dtype=torch.float32, device=device)
        self.spare = spare
        self._rooms: list[Room] = []
        self._rooms_for_rows: list[int] = []
        self._is_divided = False
        self._calls = 0
        self._fixed = False

    @contextmanager
    def step(self, *, fixed: bool) -> Iterator[None]:
        """Around the rasterizations of one step.

        Args:
            fixed: Give each call the room of the last :meth:`measure`; otherwise each reads its own number back.

        Raises:
            UserError: for a fixed room before anything was measured.
        """
        if fixed and not self._rooms:
            raise UserError(
                "PairCapacity.step(fixed=True) must know how many pairs need room, and nothing was measured.",
                "Render inside step(fixed=False) first, and call measure().",
            )
        self._calls, self._fixed = 0, fixed
        self.overflow.zero_()
        outer = _active.set(self)
        try:
            yield
        finally:
            _active.reset(outer)

    def measure(self) -> None:
        """Make room for the most that was seen. Waits for the device."""
        if self._is_divided:
            torch.distributed.all_reduce(self.most_rows, op=torch.distributed.ReduceOp.MAX)
        self._rooms_for_rows = [self._with_spare(rows) for rows in self.most_rows.tolist()]
        most = zip(self.most.tolist(), self.most_listed.tolist(), strict=True)
        # where Gaussians were not counted, there may soon be more: they have no more than pairs
        self._rooms = [
            Room(self._with_spare(pairs), self._with_spare(listed or pairs), pairs) for pairs, listed in most
        ]

    def _with_spare(self, count: int) -> int:
        return max(LEAST, math.ceil(self.spare * count))

    def is_short(self) -> bool:
        """Whether there was more than room since the last :meth:`measure`. Waits for the device."""
        return next(self._short(), None) is not None

    def _short(self) -> Iterator[tuple[int, str, int, int]]:
        """Calls that had more than room: number, of what, how many, and the room."""
        for what, most, limits in (
            ("(Gaussian, tile) pairs", self.most, [room.pairs for room in self._rooms]),
            ("Gaussians in the image", self.most_listed, [room.gaussians for room in self._rooms]),
            ("Gaussians of a rank in an image", self.most_rows, self._rooms_for_rows),
        ):
            for call, (count, limit) in enumerate(zip(most.tolist(), limits)):
                if count > limit:
                    yield call, what, count, limit

    def check(self) -> None:
        """See whether all pairs had room since the last :meth:`measure`. Waits for the device.

        Raises:
            UserError: naming the pairs and the room, if a render left some out.
        """
        for call, what, count, limit in self._short():
            raise UserError(
                f"Rasterization {call + 1} of a step had {count:,} {what} and room for {limit:,}; some were left out.",
                "Call PairCapacity.measure() and capture the step again.",
            )

    def room(self) -> Room | None:
        """Room of the next call of this step; None: it reads its number of pairs back.

        Raises:
            UserError: if a step has more than ``CALLS`` calls.
        """
        self._check_calls()
        return self._rooms[self._calls] if self._fixed else None

    def room_for_rows(self) -> int | None:
        """Gaussians of each rank that a camera of the next call of this step may see; None: they are counted.

        Raises:
            UserError: if a step has more than ``CALLS`` calls.
        """
        self._check_calls()
        return self._rooms_for_rows[self._calls] if self._fixed else None

    def _check_calls(self) -> None:
        if self._calls >= CALLS:
            raise UserError(
                f"A step of PairCapacity holds at most {CALLS} rasterizations.", "Render several cameras in one call."
            )

    def note_rows(self, rows: Tensor) -> None:
        """Note the Gaussians that the next call has of this rank, room for them or not.

        Args:
            rows: int64 scalar on the device: those that the camera that sees the most sees.
        """
        self._is_divided = True
        of_call, room = self.most_rows[self._calls], self.room_for_rows()
        of_call.copy_(torch.maximum(of_call, rows))
        if room is not None:
            self.overflow.copy_(torch.maximum(self.overflow, (rows > room).to(self.overflow)))

    def note(self, totals: Tensor) -> None:
        """Note the pairs of a call, room for them or not.

        Args:
            totals: int64 on the device: [1] all pairs, or [2] and the Gaussians that have any; [0] without Gaussians.
        """
        room = self._rooms[self._calls] if self._fixed else None
        limits = None if room is None else (room.pairs, room.gaussians)
        note_totals(self._calls, limits, totals, self.most, self.most_listed, self.overflow)
        self._calls += 1


active_pair_capacity: "Callable[[], PairCapacity | None]" = _active.get
"""The one whose step is being rendered; None where every call reads its number back."""
