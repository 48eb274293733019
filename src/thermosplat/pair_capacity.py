"""Room for the (Gaussian, tile) pairs of a step known beforehand, so that no rasterization waits for the device.

A rasterization reads the number of its pairs back to the host, to allocate what they need. A step that is captured in a
CUDA graph cannot: it gets a fixed room instead, measured on the steps before, and says on the device what did not fit.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

CALLS = 8
"""Most rasterizations in a step."""

SPARE = 1.5
"""Room over the most pairs seen; between two measurements (100 steps) Gaussians grow in number and opacity."""

_active: "PairCapacity | None" = None


class PairCapacity:
    """How many pairs each rasterization of a step had, and how many the next ones have room for.

    Attributes:
        most: int64 [CALLS], most pairs of each call of a step so far.
        overflow: float32 scalar, 1 where a call of the last step had more pairs than room.

    Args:
        device: Where the renderer runs.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.most = torch.zeros(CALLS, dtype=torch.int64, device=device)
        self.overflow = torch.zeros((), device=device)
        self._limits: list[int] = []
        self._calls = 0
        self._fixed = False

    @contextmanager
    def step(self, *, fixed: bool) -> Iterator[None]:
        """Around the rasterizations of one step.

        Args:
            fixed: Give each call the room of the last :meth:`measure`; otherwise each reads its own number back.
        """
        global _active
        outer, _active = _active, self
        self._calls, self._fixed = 0, fixed
        self.overflow.zero_()
        try:
            yield
        finally:
            _active = outer

    def measure(self) -> None:
        """Make room for the most that was seen. Waits for the device."""
        self._limits = [max(1024, math.ceil(SPARE * count)) for count in self.most.tolist()]

    def is_short(self) -> bool:
        """Whether there were more pairs than room since the last :meth:`measure`. Waits for the device."""
        return any(count > limit for count, limit in zip(self.most.tolist(), self._limits))

    def limit(self) -> int | None:
        """Room of the next call of this step; None: it reads its number of pairs back."""
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
    return _active
