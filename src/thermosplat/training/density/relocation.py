"""Gaussians that become several in one place without the image changing: what 3DGS-MCMC adds and moves Gaussians by.

Kheradmand et al. 2024, equations 7 to 9. A Gaussian of opacity o and covariance Σ that becomes n in the same place gets

    o' = 1 - (1 - o)^(1/n)                                       the same opacity at the centre: 1 - (1 - o')^n = o
    Σ' = (o / D)² Σ,   D = Σ_{m=1..n} (-1)^(m-1) C(n, m) o'^m / √m

The publication's D is a double sum over i = 1..n and k = 0..i-1 of C(i-1, k) (-1)^k o'^(k+1) / √(k+1); with m = k + 1
the sum over i is C(n, m). D √(2π) σ' is the integral of 1 - (1 - o' G)^n along a line, so that it stays o √(2π) σ.
"""

import math
from collections.abc import Callable
from functools import reduce

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers, append_copies, clear_moments, copy_onto

MOST_COPIES = 51
"""Most Gaussians that one becomes at a time. The publication's code; with more the factors hardly change."""

_EPSILON = 1e-6
"""Opacities stay this far from 0 and 1, where their logits are infinite."""


def shared_opacities(opacities: Tensor, copies: Tensor) -> Tensor:
    """Opacity of each of n Gaussians that replace one (equation 9).

    Args:
        opacities: In [0, 1), float64, shape [n].
        copies: Gaussians that each becomes, >= 1, shape [n].
    """
    return -torch.expm1(torch.log1p(-opacities) / copies)


def scale_factors(opacities: Tensor, copies: Tensor) -> Tensor:
    """Factor o / D of the standard deviations of the Gaussians that replace one.

    Args:
        opacities: Of the one, in (0, 1), float64, shape [n].
        copies: Gaussians that each becomes, 1 to ``MOST_COPIES``, shape [n].
    """
    m = torch.arange(1, MOST_COPIES + 1, device=opacities.device)
    table = _coefficients().to(opacities.device)[copies.long()]  # [n, MOST_COPIES]
    powers = shared_opacities(opacities, copies)[:, None] ** m
    return opacities / (table * powers).sum(dim=-1)


@torch.no_grad()
def relocate(gaussians: Gaussians, optimizers: Optimizers, moved: Tensor, sources: Tensor, least: float) -> None:
    """Move Gaussians onto others, which share their opacity with them. All moments of both start again from zero.

    Args:
        gaussians: The Gaussians.
        optimizers: Their optimizers.
        moved: Indices of those that move, shape [n].
        sources: Indices of those they move to, none of them moved itself; repeated ones share with several. [n].
        least: Opacity below which none is lowered.
    """
    _share(gaussians, sources, least)
    copy_onto(gaussians, optimizers, moved, sources)


@torch.no_grad()
def add(gaussians: Gaussians, optimizers: Optimizers, sources: Tensor, least: float) -> None:
    """Append Gaussians in the places of others, which share their opacity with them.

    Args:
        gaussians: The Gaussians.
        optimizers: Their optimizers.
        sources: Indices of those that are doubled; repeated ones become more. [n].
        least: Opacity below which none is lowered.
    """
    _share(gaussians, sources, least)
    clear_moments(gaussians, optimizers, sources)
    append_copies(gaussians, optimizers, sources)


def _share(gaussians: Gaussians, sources: Tensor, least: float) -> None:
    """Give each source opacity and size of one of as many Gaussians as it is to become.

    With several opacities each is shared by itself; the size follows the largest, whose image shows a change most.
    """
    chosen, counts = sources.unique(return_counts=True)
    copies = (counts + 1).clamp(max=MOST_COPIES)
    logits = [gaussians.logit_opacities, *map(gaussians.logits_in, gaussians.second_opacities)]
    largest = reduce(torch.maximum, (values[chosen].double().sigmoid() for values in logits))
    factors = scale_factors(largest.clamp(_EPSILON, 1.0 - _EPSILON), copies)
    gaussians.log_scales[chosen] += factors.log().to(gaussians.log_scales.dtype)[:, None]
    lower_opacities(gaussians, chosen, lambda o: shared_opacities(o.clamp(max=1.0 - _EPSILON), copies), least)


@torch.no_grad()
def lower_opacities(gaussians: Gaussians, indices: Tensor, lowered: Callable[[Tensor], Tensor], least: float) -> None:
    """Lower every opacity of some Gaussians, each by itself.

    Args:
        gaussians: The Gaussians.
        indices: Which, int64, shape [n].
        lowered: What becomes of opacities in [0, 1], float64, shape [n].
        least: Opacity below which none falls that was not there.
    """

    def new_logits(logits: Tensor) -> Tensor:
        opacities = logits[indices].double().sigmoid()
        return torch.logit(torch.maximum(lowered(opacities), opacities.clamp(max=least)), eps=_EPSILON)

    others = {name: new_logits(gaussians.logits_in(name)) for name in gaussians.second_opacities}
    gaussians.set_opacity_logits(indices, new_logits(gaussians.logit_opacities), others)


def _coefficients() -> Tensor:
    """(-1)^(m-1) C(n, m) / √m for n = 0..MOST_COPIES and m = 1..MOST_COPIES, float64."""
    return torch.tensor(
        [
            [(-1) ** (m - 1) * math.comb(n, m) / math.sqrt(m) for m in range(1, MOST_COPIES + 1)]
            for n in range(MOST_COPIES + 1)
        ],
        dtype=torch.float64,
    )
