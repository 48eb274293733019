"""What one Gaussian becomes when several take its place: gsplat's ``compute_relocation``, and what it consists of.

Kheradmand et al. 2024, equations 7 to 9. A Gaussian of opacity o and covariance Σ that becomes n in the same place gets

    o' = 1 - (1 - o)^(1/n)                                       the same opacity at the centre: 1 - (1 - o')^n = o
    Σ' = (o / D)² Σ,   D = Σ_{m=1..n} (-1)^(m-1) C(n, m) o'^m / √m

The publication's D is a double sum over i = 1..n and k = 0..i-1 of C(i-1, k) (-1)^k o'^(k+1) / √(k+1); with m = k + 1
the sum over i is C(n, m). D √(2π) σ' is the integral of 1 - (1 - o' G)^n along a line, so that it stays o √(2π) σ.
"""

import functools
import math

import torch
from torch import Tensor

from thermosplat.errors import UserError

MOST_COPIES = 51
"""Most Gaussians that one becomes at a time. The publication's code; with more the factors hardly change."""

OPAQUE = 1.0 - 2.0**-24
"""Largest opacity that is shared, the largest below 1 in float32: of 1 the terms of D are as large as C(n, m)."""


@torch.no_grad()
def compute_relocation(
    opacities: Tensor,  # [N] or [N, 1]
    scales: Tensor,  # [N, 3]
    ratios: Tensor,  # [N]
    binoms: Tensor,  # [n_max, n_max]
    min_opacity: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Opacities and scales of Gaussians that others join in their places; gsplat's function, on the CPU too.

    Takes the place of ``gsplat.relocation.compute_relocation``, which ``gsplat.MCMCStrategy`` calls as
    ``gsplat.strategy.ops.compute_relocation``.

    Args:
        opacities: In [0, 1], [N] or [N, 1].
        scales: Standard deviations, [N, 3].
        ratios: Gaussians that each becomes, [N]; less than 1 counts as 1, and more than n_max as n_max.
        binoms: gsplat's table of binomial coefficients, [n_max, n_max], of which only the size is read.
        min_opacity: Opacity below which none is shared, as gsplat's main branch has it (0.005 there).

    Returns:
        ``(new_opacities, new_scales)``, of the shapes and types of ``opacities`` and ``scales``.

    Raises:
        UserError: The shapes do not go together.
    """
    count = len(opacities)
    if opacities.numel() != count or scales.shape != (count, 3) or ratios.shape != (count,):
        raise UserError(
            "opacities, scales and ratios must have shapes [N], [N, 3] and [N], got "
            f"{list(opacities.shape)}, {list(scales.shape)} and {list(ratios.shape)}."
        )
    most = len(binoms)
    single, copies = opacities.reshape(-1).double().clamp(max=OPAQUE), ratios.clamp(1, most)
    shared = shared_opacities(single, copies).clamp(min_opacity, OPAQUE)
    factors = scale_factors(single, copies, shared, most)
    return shared.reshape(opacities.shape).to(opacities.dtype), scales * factors.to(scales.dtype)[:, None]


def shared_opacities(opacities: Tensor, copies: Tensor) -> Tensor:
    """Opacity of each of n Gaussians that replace one (equation 9).

    Args:
        opacities: In [0, 1), float64, shape [n].
        copies: Gaussians that each becomes, >= 1, shape [n].
    """
    return -torch.expm1(torch.log1p(-opacities) / copies)


def scale_factors(opacities: Tensor, copies: Tensor, shared: Tensor | None = None, most: int = MOST_COPIES) -> Tensor:
    """Factor o / D of the standard deviations of the Gaussians that replace one; 1, the limit, of none at all.

    Args:
        opacities: Of the one, in [0, 1), float64, shape [n].
        copies: Gaussians that each becomes, 1 to ``most``, shape [n].
        shared: Their opacities, shape [n]; None: ``shared_opacities``.
        most: The most of them.
    """
    shared = shared_opacities(opacities, copies) if shared is None else shared
    table = coefficients(most).to(opacities.device)[copies.long()]  # [n, most]
    sums = (table * shared[:, None] ** torch.arange(1, most + 1, device=opacities.device)).sum(dim=-1)
    return torch.where(sums > 0, opacities / sums, 1.0)


@functools.lru_cache(maxsize=4)
def coefficients(most: int) -> Tensor:
    """(-1)^(m-1) C(n, m) / √m for n = 0..most and m = 1..most, float64."""
    return torch.tensor(
        [[(-1) ** (m - 1) * math.comb(n, m) / math.sqrt(m) for m in range(1, most + 1)] for n in range(most + 1)],
        dtype=torch.float64,
    )
