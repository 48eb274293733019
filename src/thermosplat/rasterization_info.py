"""gsplat's dictionary of intermediate results, of which the costly one is computed when it is read."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor


class RasterizationInfo(dict[str, Any]):
    """The third result of ``rasterization``: gsplat's keys. ``isect_ids`` is computed when first read."""

    def __init__(self, values: dict[str, Any], isect_ids: Callable[[], Tensor]) -> None:
        super().__init__(values, isect_ids=None)
        self._isect_ids = isect_ids

    def __getitem__(self, key: str) -> Any:
        if key == "isect_ids" and super().__getitem__(key) is None:
            self[key] = self._isect_ids()
        return super().__getitem__(key)

    def __iter__(self) -> Iterator[str]:
        # Defined so that dict(info) and {**info} read through __getitem__.
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        """As ``dict.get``."""
        if key not in self:
            return default
        return self[key]

    def items(self) -> Any:
        """As ``dict.items``, with every value computed."""
        self["isect_ids"]
        return super().items()

    def values(self) -> Any:
        """As ``dict.values``, with every value computed."""
        self["isect_ids"]
        return super().values()


def isect_ids(flatten_ids: Tensor, tile_offsets: Tensor, depths: Tensor, tiles: int) -> Tensor:
    """gsplat's sort keys: image, tile and depth bits packed into an int64, one a (Gaussian, tile) pair.

    Args:
        flatten_ids: int32 [pairs], flat (image, Gaussian) index of each sorted pair.
        tile_offsets: int32 [images · tiles + 1], first sorted pair of each tile; the last entry is the number of pairs.
        depths: [images · N], world units.
        tiles: tiles in an image.

    Returns:
        int64 [pairs], ascending.
    """
    counts = tile_offsets.diff()
    image_tile = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    tile_bits = tiles.bit_length()
    key = ((image_tile // tiles) << tile_bits) | (image_tile % tiles)
    bits = depths.float()[flatten_ids.long()].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (key << 32) | bits
