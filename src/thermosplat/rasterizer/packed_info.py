"""``info`` as gsplat's packed mode has it: one row for each Gaussian that a camera sees, and of which Gaussian it is.

The rows are picked from the ``info`` of a call that is not packed, when an entry is first read; who reads none pays for
none. The image's gradient goes by the whole tensors, which hand it on to the rows.
"""

import functools
import inspect
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from thermosplat.rasterizer.info import RasterizationInfo

Function = TypeVar("Function", bound=Callable[..., Any])

IDS = ("batch_ids", "camera_ids", "gaussian_ids")
PICKED = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")
"""Entries of one value or row for each Gaussian before each camera."""

PAIRS = "flatten_ids"
"""Flat indices of Gaussians, which become those of rows."""


def packed_where_asked(function: Function) -> Function:
    """Lets a function that always returns whole tensors in ``info`` return packed ones, as its ``packed`` says.

    Args:
        function: ``rasterization``.
    """
    names = list(inspect.signature(function).parameters)
    packed_at, distributed_at = names.index("packed"), names.index("distributed")

    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        *images, info = function(*arguments, **options)
        if arguments[packed_at] if len(arguments) > packed_at else options.get("packed", True):
            among = arguments[distributed_at] if len(arguments) > distributed_at else options.get("distributed", False)
            pack(info, distributed=bool(among))
        return *images, info

    return cast("Function", called)


def pack(info: RasterizationInfo, *, distributed: bool) -> None:
    """Gives one row to each Gaussian that a camera sees, in the order of scenes, cameras and Gaussians.

    Args:
        info: Of a call that is not packed, changed in place. Nothing is computed before it is read.
        distributed: Pairs and tiles are those of the Gaussians that this rank received, as in gsplat, and stay.
    """
    # What reads the whole tensors holds them and not the dictionary, which would hold itself.
    whole: dict[str, Callable[[], Tensor]] = {}
    for key in (*PICKED, PAIRS, "visible"):
        whole[key] = info.computed.get(key) or partial(_the_same, dict.get(info, key))

    @functools.cache
    def rows() -> PackedRows:
        return PackedRows(whole["visible"]())

    def ids(place: int) -> Tensor:
        return rows().ids[place]

    def picked(key: str) -> Tensor:
        return rows().shown(whole[key]())

    for place, key in enumerate(IDS):
        info.computed[key] = partial(ids, place)
    for key in PICKED:
        info.computed[key] = partial(picked, key)
    info.computed[PAIRS] = lambda: rows().numbered(whole[PAIRS]())
    if distributed:
        for key in ("tiles_per_gauss", PAIRS):
            info.computed[key] = whole[key]


def _the_same(value: Any) -> Any:
    return value


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
