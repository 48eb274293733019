"""gsplat 1.5.3's own torch reference of ``rasterization``, on machines without its CUDA extension.

The wheel ships the reference (``gsplat.rendering._rasterization``), which needs CUDA for four small parts and nerfacc
for two. Here they are in torch, in the reference's precision; everything that is compared with is gsplat's.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN = 0.999, 1.0 / 255.0, 1e-4
"""gsplat's clamp of alpha, the least one that is drawn, and where a pixel ends."""


def install() -> Callable[..., Any]:
    """Puts the parts into gsplat.

    Returns:
        The reference: arguments and results of ``gsplat.rasterization``.

    Raises:
        ImportError: if gsplat is not installed.
    """
    nerfacc = ModuleType("nerfacc")
    nerfacc.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    nerfacc.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    sys.modules["nerfacc"] = nerfacc
    for module, name, part in _parts():
        setattr(module, name, part)
    from gsplat import rendering

    return rendering._rasterization


@contextmanager
def installed() -> Iterator[Callable[..., Any]]:
    """``install``, and gsplat as it was afterwards."""
    saved = [(module, name, getattr(module, name)) for module, name, _ in _parts()]
    nerfacc = sys.modules.get("nerfacc")
    try:
        yield install()
    finally:
        for module, name, part in saved:
            setattr(module, name, part)
        if nerfacc is None:
            sys.modules.pop("nerfacc", None)
        else:
            sys.modules["nerfacc"] = nerfacc


def _parts() -> list[tuple[ModuleType, str, Callable[..., Any]]]:
    from gsplat import rendering
    from gsplat.cuda import _torch_impl, _wrapper

    def spherical_harmonics(degree: int, directions: Tensor, coefficients: Tensor, masks: Tensor | None = None) -> Any:
        return _torch_impl._spherical_harmonics(degree, directions, coefficients)  # what is masked is not read

    return [
        (_wrapper, "rasterize_to_indices_in_range", rasterize_to_indices_in_range),
        (rendering, "isect_tiles", isect_tiles),
        (rendering, "isect_offset_encode", _torch_impl._isect_offset_encode),
        (rendering, "spherical_harmonics", spherical_harmonics),
    ]


def render_weight_from_alpha(alphas: Tensor, *, ray_indices: Tensor, **_: Any) -> tuple[Tensor, Tensor]:
    """Blending weights T alpha and transmittances T of samples that are grouped by ray, front to back.

    Args:
        alphas: [samples].
        ray_indices: [samples].

    Returns:
        The weights and the transmittances before each sample.
    """
    if len(alphas) == 0:
        return alphas, alphas
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, 0) - logs
    first = torch.cat([ray_indices.new_ones(1, dtype=torch.bool), ray_indices[1:] != ray_indices[:-1]])
    transmittances = torch.exp(before - before[first][torch.cumsum(first, 0) - 1])
    return (transmittances * alphas.double()).to(alphas.dtype), transmittances.to(alphas.dtype)


def accumulate_along_rays(weights: Tensor, values: Tensor | None = None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Sums of weights [samples], times values [samples, D] where they are given, by ray, [rays, D or 1]."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return weighted.new_zeros(n_rays, weighted.shape[-1]).index_add(0, ray_indices, weighted)


@torch.no_grad()
def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Which Gaussians which pixels see, of so many batches of tile_size² pairs of each tile.

    Returns:
        Gaussians, pixels and images of all (pixel, Gaussian) pairs that are drawn, pixels together, front to back.
    """
    count = means2d.shape[-2]
    means, conics, opacities = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    rows, columns = isect_offsets.shape[-2:]
    transmittances = transmittances.reshape(-1, image_height, image_width)
    ends = [*isect_offsets.reshape(-1).tolist(), len(flatten_ids)]
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for tile in range(len(ends) - 1):
        start = ends[tile] + range_start * tile_size**2
        end = min(ends[tile + 1], ends[tile] + range_end * tile_size**2)
        if start >= end:
            continue
        ids = flatten_ids[start:end].long()
        image, row, column = tile // (rows * columns), tile // columns % rows, tile % columns
        ys = torch.arange(row * tile_size, min((row + 1) * tile_size, image_height))
        xs = torch.arange(column * tile_size, min((column + 1) * tile_size, image_width))
        y, x = (grid.reshape(-1) for grid in torch.meshgrid(ys, xs, indexing="ij"))
        dx = means[ids, 0] - (x.to(means.dtype) + 0.5)[:, None]
        dy = means[ids, 1] - (y.to(means.dtype) + 0.5)[:, None]
        a, b, c = conics[ids].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = torch.clamp_max(opacities[ids] * torch.exp(-sigma), ALPHA_MAX)
        drawn = (sigma >= 0) & (alpha >= ALPHA_MIN)
        alpha = torch.where(drawn, alpha, 0.0)
        # The pair that would take T below the limit is not drawn; T falls, so what is drawn comes before it.
        drawn &= transmittances[image, y, x][:, None] * torch.cumprod(1 - alpha, 1) > TRANSMITTANCE_MIN
        pixel, pair = torch.nonzero(drawn, as_tuple=True)
        found.append((ids[pair] % count, (y * image_width + x)[pixel], torch.full_like(pair, image)))
    if not found:
        nothing = torch.zeros(0, dtype=torch.long)
        return nothing, nothing, nothing
    gaussians, pixels, images = (torch.cat(part) for part in zip(*found, strict=True))
    order = torch.argsort(images * (image_width * image_height) + pixels, stable=True)
    return gaussians[order], pixels[order], images[order]


@torch.no_grad()
def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Vectorised twin of gsplat's ``_isect_tiles``, which loops in Python; for Gaussians that are not packed.

    Returns:
        Tiles per Gaussian [..., N], sorted keys (image, tile, depth), and the Gaussian of each.
    """
    count = means2d.shape[-2]
    means, reach = means2d.reshape(-1, 2) / tile_size, radii.reshape(-1, 2) / tile_size
    limits = torch.tensor([tile_width, tile_height])
    low = torch.minimum(torch.floor(means - reach).long().clamp_min(0), limits)
    high = torch.minimum(torch.ceil(means + reach).long().clamp_min(0), limits)
    extent = (high - low).clamp_min(0)
    tiles = extent.prod(-1) * (radii.reshape(-1, 2) > 0).all(-1)
    ids = torch.repeat_interleave(tiles)
    within = torch.arange(len(ids)) - (torch.cumsum(tiles, 0) - tiles)[ids]
    width = extent[ids, 0]
    tile = (low[ids, 1] + within // width) * tile_width + low[ids, 0] + within % width
    depth = depths.reshape(-1).float().contiguous().view(torch.int32)[ids].long() & 0xFFFFFFFF
    bits = (tile_width * tile_height).bit_length()
    keys, order = torch.sort(((((ids // count) << bits) | tile) << 32) | depth, stable=True)
    return tiles.reshape(means2d.shape[:-1]).int(), keys, ids[order].int()
