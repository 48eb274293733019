"""``info`` as gsplat's packed mode has it: one row for each Gaussian that a camera sees, and of which Gaussian it is.

The rows are picked from the entries of a call that is not packed, when one of them is first read; who reads none pays
for none. The image's gradient goes by the whole tensors, which hand it on to the rows.
"""

import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from thermosplat.rasterizer.info import Entries

IDS = ("batch_ids", "camera_ids", "gaussian_ids")
PICKED = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")
"""Entries of one value or row for each Gaussian before each camera."""

PAIRS = "flatten_ids"
"""Flat indices of Gaussians, which become those of rows."""


@dataclass(eq=False)
class PackedEntries:
    """One row for each Gaussian that a camera sees, in the order of scenes, cameras and Gaussians."""

    whole: Entries
    """The entries of a call that is not packed."""

    are_of_ranks: ClassVar[bool] = False  # not asked of these

    @property
    def keys(self) -> Iterable[str]:
        """Of the entries."""
        return self.whole.keys

    @cached_property
    def _rows(self) -> "PackedRows":
        return PackedRows(self.whole.made("visible"))

    def made(self, key: str) -> Any:
        """The value of one of the keys."""
        if key in IDS:
            return self._rows.ids[IDS.index(key)]
        value = self.whole.made(key)
        if key in ("tiles_per_gauss", PAIRS) and self.whole.are_of_ranks:
            return value  # pairs and tiles of the Gaussians that this rank received, as in gsplat
        if key == PAIRS:
            return self._rows.numbered(value)
        return self._rows.shown(value) if key in PICKED else value


def whole_entries(entries: Entries) -> Entries:
    """The entries of the call that is not packed."""
    return entries.whole if isinstance(entries, PackedEntries) else entries


class PackedRows:
    """Which Gaussians are seen.

    Args:
        visible: bool [..., C, N].
    """

    def __init__(self, visible: Tensor) -> None:
        self._visible = visible
        by_scene = visible.reshape(visible.shape[:-2].numel(), *visible.shape[-2:])
        self.ids = scenes, cameras, gaussians = by_scene.nonzero().unbind(-1)
        """Scene, camera and Gaussian of each row, int64 [nnz]; to know them the device is waited for."""
        self._flat = (scenes * visible.shape[-2] + cameras) * visible.shape[-1] + gaussians

    @torch.enable_grad()
    def of(self, whole: Tensor) -> Tensor:
        """The rows of a tensor [..., C, N] or [..., C, N, X]."""
        return whole.reshape(self._visible.numel(), *whole.shape[self._visible.dim() :])[self._flat]

    def numbered(self, flatten_ids: Tensor) -> Tensor:
        """Flat indices [pairs] of whole tensors as rows; those behind the last pair, which mean nothing, as any."""
        places = self._visible.flatten().cumsum(0) - 1
        return places[flatten_ids.long().clamp(0, len(places) - 1)].int() if len(places) > 0 else flatten_ids

    def shown(self, whole: Tensor) -> Tensor:
        """The rows of a tensor; if they retain gradients, they get the rows of its own, and of its ``absgrad``."""
        packed = self.of(whole)
        if not whole.requires_grad:
            return packed
        # Weak, or what the graph holds would hold the graph.
        rows, shown, source, sums = self._flat, weakref.ref(packed), weakref.ref(whole), list[Tensor]()
        count = self._visible.numel()

        def hand_on(gradient: Tensor) -> None:
            mine = shown()
            if mine is None:
                return
            if mine.retains_grad:
                found = gradient.detach().reshape(count, *mine.shape[1:])[rows]
                sums[:] = [found if not sums else sums[0] + found]
                mine.grad = sums[0]
            absolute = getattr(source(), "absgrad", None)
            if absolute is not None:
                mine.absgrad = absolute.reshape(count, 2)[rows]  # type: ignore[attr-defined]

        whole.register_hook(hand_on)
        return packed
