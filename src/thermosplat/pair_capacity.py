"""Room for the (Gaussian, tile) pairs of a step known beforehand, so that no rasterization waits for the device.

A rasterization reads the number of its pairs back to the host, to allocate what they need. A step that is captured in a
CUDA graph cannot: it gets a fixed room instead, measured on the steps before, and says on the device what did not fit.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from thermosplat.errors import UserError

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
    be captured. Pairs that find no room, those of the farthest Gaussians, are not drawn and get no gradient;
    ``overflow`` and :meth:`check` tell.

    Args:
        device: Where the renderer runs.
        spare: Room over the most pairs seen, as a factor; what is not used costs memory and sorting.

    Attributes:
        most: int64 [CALLS], most pairs of each call of a step so far.
        overflow: float32 scalar on the device, 1 where a call of the last step (or replay) had more pairs than room.

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
        self.overflow = torch.zeros((), device=device)
        self.spare = spare
        self._limits: list[int] = []
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
        if fixed and not self._limits:
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
        self._limits = [max(LEAST, math.ceil(self.spare * count)) for count in self.most.tolist()]

    def is_short(self) -> bool:
        """Whether there were more pairs than room since the last :meth:`measure`. Waits for the device."""
        return any(count > limit for count, limit in zip(self.most.tolist(), self._limits))

    def check(self) -> None:
        """See whether all pairs had room since the last :meth:`measure`. Waits for the device.

        Raises:
            UserError: naming the pairs and the room, if a render left some out.
        """
        for call, (count, limit) in enumerate(zip(self.most.tolist(), self._limits)):
            if count > limit:
                raise UserError(
                    f"Rasterization {call + 1} of a step had {count:,} (Gaussian, tile) pairs and room for {limit:,}; "
                    "the farthest were left out.",
                    "Call PairCapacity.measure() and capture the step again.",
                )

    def limit(self) -> int | None:
        """Room of the next call of this step; None: it reads its number of pairs back.

        Raises:
            UserError: if a step has more than ``CALLS`` calls.
        """
        if self._calls >= CALLS:
            raise UserError(
                f"A step of PairCapacity holds at most {CALLS} rasterizations.", "Render several cameras in one call."
            )
        return self._limits[self._calls] if self._fixed else None

    @torch.no_grad()
    def note(self, pairs: Tensor) -> None:
        """Note the pairs of a call.

        Args:
            pairs: int64 [1] on the device, all pairs, also those there was no room for; [0] without Gaussians.
        """
        if pairs.numel() > 0:
            most = self.most[self._calls : self._calls + 1]
            most.copy_(torch.maximum(most, pairs))
            if self._fixed:
                short = (pairs > self._limits[self._calls]).to(self.overflow.dtype).squeeze()
                self.overflow.copy_(torch.maximum(self.overflow, short))
        self._calls += 1


def active_pair_capacity() -> PairCapacity | None:
    """The one whose step is being rendered; None where every call reads its number back."""
    return _active.get()
