"""gsplat's dictionary of intermediate results, whose entries are made when they are read."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from warp_kernels.constants import RADIUS_MAX


class Entries(Protocol):
    """What makes the entries of a dictionary."""

    @property
    def are_of_ranks(self) -> bool:
        """Whether Gaussians are those of this rank alone, pairs and tiles those that it received of all ranks."""

    @property
    def keys(self) -> Iterable[str]:
        """Of the entries."""

    def made(self, key: str) -> Any:
        """The value of one of the keys."""


class RasterizationInfo(dict[str, Any]):
    """The third result of ``rasterization``: gsplat's keys and some of our own.

    Args:
        entries: makes them when they are first read.
    """

    def __init__(self, entries: Entries) -> None:
        keys = entries.keys
        super().__init__(dict.fromkeys(keys))
        self.entries = entries
        self._unread = set(keys)

    def __getitem__(self, key: str) -> Any:
        if key in self._unread:
            self[key] = self.entries.made(key)  # which forgets that it was unread; one that fails can be tried again
        return super().__getitem__(key)

    def __setitem__(self, key: str, value: Any) -> None:
        self._unread.discard(key)
        super().__setitem__(key, value)

    def __delitem__(self, key: str) -> None:
        super().__delitem__(key)
        self._unread.discard(key)

    def __iter__(self) -> Iterator[str]:
        # Defined so that dict(info), {**info} and info.copy() read through __getitem__.
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        """As ``dict.get``."""
        if key not in self:
            return default
        return self[key]

    def pop(self, key: str, *default: Any) -> Any:
        """As ``dict.pop``."""
        if key in self._unread:
            self[key]
        return super().pop(key, *default)

    def setdefault(self, key: str, default: Any = None) -> Any:
        """As ``dict.setdefault``."""
        if key in self._unread:
            return self[key]
        return super().setdefault(key, default)

    # dict's own of these go past __getitem__, __setitem__ and __delitem__.

    def popitem(self) -> tuple[str, Any]:
        """As ``dict.popitem``."""
        key = next(reversed(self), None)
        return super().popitem() if key is None else (key, self.pop(key))

    def update(self, *values: Any, **named: Any) -> None:
        """As ``dict.update``."""
        for key, value in dict(*values, **named).items():
            self[key] = value

    def __ior__(self, other: Any) -> "RasterizationInfo":  # type: ignore[override,misc]
        self.update(other)
        return self

    def clear(self) -> None:
        """As ``dict.clear``."""
        self._unread.clear()
        super().clear()

    def items(self) -> Any:
        """As ``dict.items``, with every value made."""
        self._read_all()
        return super().items()

    def values(self) -> Any:
        """As ``dict.values``, with every value made."""
        self._read_all()
        return super().values()

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)  # pickled and copied as a plain dict: what makes the entries stays here

    def _read_all(self) -> None:
        for key in list(self._unread):
            self[key]


class InfoTensors(NamedTuple):
    """What the dictionary is made of."""

    means2d: Tensor
    """[..., C, N, 2] px, as are those below where ``rasterization`` names them; not written of Gaussians that are not
    visible."""
    visible: Tensor
    """bool [..., C, N]."""
    extents: Tensor
    """Half the bounding boxes of what is drawn, [..., C, N, 2] px; see ``radii_of``. Not written, as means2d."""
    depths: Tensor
    """Not written, as means2d."""
    roots: Tensor
    """Of inverse 2D covariances, [..., C, N, 3]; see ``conics``."""
    opacities: Tensor
    thermal_opacities: Tensor | None
    flatten_ids: Tensor
    tile_offsets: Tensor
    """int32 [images · tiles + 1], first sorted pair of each tile; the last entry is the number of pairs."""
    tiles_per_gaussian: Tensor
    """int32 [images · N]."""


class TiledSize(NamedTuple):
    """An image's size and tiles."""

    width: int
    height: int
    tile_size: int
    tiles_x: int
    tiles_y: int


class SceneEntries(NamedTuple):
    """The entries of a scene that was blended; holds what they are made of, and not the scene."""

    tensors: InfoTensors
    size: TiledSize
    count_nonfinite: Callable[[], int]
    """Counts what ``num_nonfinite`` says."""

    @property
    def are_of_ranks(self) -> bool:
        """See ``Entries``."""
        return False

    @property
    def keys(self) -> Iterable[str]:
        """Of the entries."""
        return _MAKERS if self.tensors.thermal_opacities is not None else _MAKERS_OF_ONE_OPACITY

    def made(self, key: str) -> Any:
        """The value of one of the keys."""
        return _MAKERS[key](self)


@torch.enable_grad()
def _recorded_conics(roots: Tensor, visible: Tensor) -> Tensor:
    """``conics`` with their gradient, also where they are first read under ``no_grad``."""
    return conics(roots, visible)


def _isect_ids(e: SceneEntries) -> Tensor:
    t = e.tensors
    return isect_ids(t.flatten_ids, t.tile_offsets, t.depths.detach().flatten(), e.size.tiles_x * e.size.tiles_y)


_MAKERS: dict[str, Callable[[SceneEntries], Any]] = {
    "batch_ids": lambda e: None,
    "camera_ids": lambda e: None,
    "gaussian_ids": lambda e: None,
    "visible": lambda e: e.tensors.visible,
    "opacities": lambda e: e.tensors.opacities,
    "tile_width": lambda e: e.size.tiles_x,
    "tile_height": lambda e: e.size.tiles_y,
    "flatten_ids": lambda e: e.tensors.flatten_ids,
    "width": lambda e: e.size.width,
    "height": lambda e: e.size.height,
    "tile_size": lambda e: e.size.tile_size,
    "n_batches": lambda e: math.prod(e.tensors.visible.shape[:-2]),
    "n_cameras": lambda e: e.tensors.visible.shape[-2],
    "radii": lambda e: radii_of(e.tensors.extents, e.tensors.visible),
    "means2d": lambda e: clear_unseen(e.tensors.means2d, e.tensors.visible),
    "depths": lambda e: clear_unseen(e.tensors.depths, e.tensors.visible),
    "conics": lambda e: _recorded_conics(e.tensors.roots, e.tensors.visible),
    "tiles_per_gauss": lambda e: e.tensors.tiles_per_gaussian.reshape(e.tensors.visible.shape),
    "isect_offsets": lambda e: e.tensors.tile_offsets[:-1].reshape(
        *e.tensors.visible.shape[:-1], e.size.tiles_y, e.size.tiles_x
    ),
    "isect_ids": _isect_ids,
    "num_nonfinite": lambda e: e.count_nonfinite(),
    "thermal_opacities": lambda e: e.tensors.thermal_opacities,
}
_MAKERS_OF_ONE_OPACITY = [key for key in _MAKERS if key != "thermal_opacities"]


def num_nonfinite(
    inputs: Iterable[tuple[Tensor, int]], cameras: Iterable[Tensor], scenes: int, num_gaussians: int
) -> int:
    """Number of Gaussians, over all scenes, with a NaN or an infinity in any input, or before a camera that has one.

    Waits for the device.

    Args:
        inputs: each with its number of values per Gaussian; scene by scene, in each Gaussian by Gaussian, or camera by
            camera and then Gaussian by Gaussian.
        num_gaussians: N, Gaussians of a scene.
    """
    if scenes * num_gaussians == 0:
        return 0
    finite = [
        tensor.detach().isfinite().reshape(scenes, -1, num_gaussians, width).all(-1).all(1)
        for tensor, width in inputs
        if width > 0
    ]
    for tensor in cameras:
        finite.append(tensor.detach().isfinite().reshape(scenes, -1).all(1, keepdim=True).expand(finite[0].shape))
    return int((~torch.stack(finite).all(0)).sum())


def radii_of(extents: Tensor, visible: Tensor) -> Tensor:
    """gsplat's radii, int32 [..., 2] px: half the bounding boxes of what is drawn, rounded up; 0 where nothing is.

    Args:
        extents: [..., 2] px.
        visible: bool [...].
    """
    return torch.where(visible[..., None], extents.ceil().clamp(max=RADIUS_MAX), 0.0).int()


def clear_unseen(tensor: Tensor, visible: Tensor) -> Tensor:
    """Writes zeros where a tensor has no values, which the projection of unseen Gaussians leaves as they are.

    Nothing has read them, so that autograd need not know.

    Args:
        tensor: [...] or [..., 2], changed in place.
        visible: bool [...].
    """
    unseen = ~(visible if tensor.dim() == visible.dim() else visible[..., None])
    tensor.data.masked_fill_(unseen, 0.0)
    return tensor


def conics(roots: Tensor, visible: Tensor) -> Tensor:
    """Inverse 2D covariances [..., 3] (xx, xy, yy) [1/px²] of their roots (u, k, v) [..., 3]: Uᵀ U, U = [u, u k; 0, v].

    Zero where ``visible`` [...] is False: there roots are not defined.

    Differentiable: a loss on them reaches the Gaussians. (The image's own gradient goes through the roots.)
    """
    u, k, v = torch.where(visible[..., None], roots, 0.0).unbind(-1)
    uk = u * k
    return torch.stack([u * u, u * uk, uk * uk + v * v], -1)


def isect_ids(flatten_ids: Tensor, tile_offsets: Tensor, depths: Tensor, tiles: int) -> Tensor:
    """gsplat's sort keys: image, tile and depth bits packed into an int64, one a (Gaussian, tile) pair.

    Args:
        flatten_ids: int32 [pairs], flat (image, Gaussian) index of each sorted pair; what lies behind the last pair,
            where there was room for more, is left out.
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
    pairs = flatten_ids[: len(image_tile)].long()
    bits = depths.float()[pairs].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (key << 32) | bits
