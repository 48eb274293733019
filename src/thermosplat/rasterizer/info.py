"""gsplat's dictionary of intermediate results, of which costly ones are computed when they are read."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from warp_kernels.constants import RADIUS_MAX


class RasterizationInfo(dict[str, Any]):
    """The third result of ``rasterization``: gsplat's keys and some of our own.

    Args:
        values: what is at hand.
        computed: what is computed when it is first read, by key.
    """

    def __init__(self, values: dict[str, Any], computed: dict[str, Callable[[], Any]]) -> None:
        super().__init__(values, **dict.fromkeys(computed))
        self.computed = computed
        """By key, what is computed when it is first read."""

    def __getitem__(self, key: str) -> Any:
        if key in self.computed:
            self[key] = self.computed[key]()  # which forgets the computation; one that fails can be tried again
        return super().__getitem__(key)

    def __setitem__(self, key: str, value: Any) -> None:
        self.computed.pop(key, None)
        super().__setitem__(key, value)

    def __delitem__(self, key: str) -> None:
        super().__delitem__(key)
        self.computed.pop(key, None)

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
        if key in self.computed:
            self[key]
        return super().pop(key, *default)

    def setdefault(self, key: str, default: Any = None) -> Any:
        """As ``dict.setdefault``."""
        if key in self.computed:
            return self[key]
        return super().setdefault(key, default)

    def compute_later(self, key: str, compute: Callable[[], Any]) -> None:
        """Let a key have a value that is computed when it is first read.

        Args:
            key: The key; a value that it has is forgotten.
            compute: Computes the value.
        """
        self[key] = None
        self.computed[key] = compute

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
        self.computed.clear()
        super().clear()

    def items(self) -> Any:
        """As ``dict.items``, with every value computed."""
        self._compute_all()
        return super().items()

    def values(self) -> Any:
        """As ``dict.values``, with every value computed."""
        self._compute_all()
        return super().values()

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)  # pickled and copied as a plain dict: what is still to compute is a function

    def _compute_all(self) -> None:
        for key in list(self.computed):
            self[key]


@torch.enable_grad()
def _recorded_conics(roots: Tensor, visible: Tensor) -> Tensor:
    """``conics`` with their gradient, also where they are first read under ``no_grad``."""
    return conics(roots, visible)


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


def rasterization_info(tensors: InfoTensors, size: TiledSize, count_nonfinite: Callable[[], int]) -> RasterizationInfo:
    """gsplat's dictionary.

    Args:
        tensors: What it is made of; held as long as something may have to be computed of it.
        size: Of the images.
        count_nonfinite: Counts what ``num_nonfinite`` says, when that is read.

    Returns:
        The dictionary, whose costly entries are computed when they are read.
    """
    *shape, count = tensors.visible.shape
    flatten_ids, tile_offsets = tensors.flatten_ids, tensors.tile_offsets
    depths, tiles_per_gaussian = tensors.depths, tensors.tiles_per_gaussian
    visible, roots = tensors.visible, tensors.roots
    tiles_y, tiles_x = size.tiles_y, size.tiles_x
    values = {
        "batch_ids": None,
        "camera_ids": None,
        "gaussian_ids": None,
        "visible": visible,
        "opacities": tensors.opacities,
        "tile_width": tiles_x,
        "tile_height": tiles_y,
        "flatten_ids": flatten_ids,
        "width": size.width,
        "height": size.height,
        "tile_size": size.tile_size,
        "n_batches": math.prod(shape[:-1]),
        "n_cameras": shape[-1],
    }
    if tensors.thermal_opacities is not None:
        values["thermal_opacities"] = tensors.thermal_opacities
    return RasterizationInfo(
        values,
        {
            **entries_of_seen(tensors.means2d, depths, tensors.extents, visible),
            "conics": lambda: _recorded_conics(roots, visible),
            "tiles_per_gauss": lambda: tiles_per_gaussian.reshape(*shape, count),
            "isect_offsets": lambda: tile_offsets[:-1].reshape(*shape, tiles_y, tiles_x),
            "isect_ids": lambda: isect_ids(flatten_ids, tile_offsets, depths.detach().flatten(), tiles_x * tiles_y),
            "num_nonfinite": count_nonfinite,
        },
    )


def num_nonfinite(
    inputs: Iterable[tuple[Tensor, int]], cameras: Iterable[Tensor], scenes: int, num_gaussians: int
) -> int:
    """Number of Gaussians, over all scenes, with a NaN or an infinity in any input, or before a camera that has one.

    Waits for the device.

    Args:
        inputs: each with its number of values per Gaussian; scene by scene, in each Gaussian by Gaussian, or camera by
            camera and then Gaussian by Gaussian.
        cameras: view matrices and intrinsics, scene by scene.
        scenes: number of scenes.
        num_gaussians: N, Gaussians of a scene.

    Returns:
        The number.
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


def entries_of_seen(
    means2d: Tensor, depths: Tensor, extents: Tensor, visible: Tensor
) -> dict[str, Callable[[], Tensor]]:
    """The entries that are 0 where a Gaussian is not seen, each with what computes it when it is read.

    Args:
        means2d: As in ``InfoTensors``, as are the others.
        depths: Likewise.
        extents: Likewise.
        visible: Likewise.
    """
    return {
        "radii": lambda: radii_of(extents, visible),
        "means2d": lambda: clear_unseen(means2d, visible),
        "depths": lambda: clear_unseen(depths, visible),
    }


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

    Returns:
        The tensor.
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
