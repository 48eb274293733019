"""Gaussians that become two side by side, along their longest axis.

What 3DGS-MCMC doubles stays in one place (relocation.py): both have the same gradients, and only noise parts them. Deng
et al. 2025 (ImprovedGS, arXiv 2508.12313) split along the longest axis, by constants of their own. Here the image
changes as little as one number, the distance d, lets it. Along the longest axis a Gaussian of standard deviation σ and
opacity o becomes two at ±dσ, with

    σ' = √(1 - d²) σ                                              together the variance σ² of the one
    2 o' - o'² e^(-d²/(1 - d²)) / √2 = o / √(1 - d²)              together as opaque along a line through both

The second says that ∫ 1 - (1 - o' G₁)(1 - o' G₂) = ∫ o G, since ∫ G₁ G₂ = √π σ' e^(-(dσ/σ')²). The other axes stay.
"""

import math

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.rotation import rotate
from thermosplat.training.density.gaussian_ops import Optimizers, append_copies, clear_moments, copy_onto
from thermosplat.training.density.relocation import lower_opacities


def halves_opacities(opacities: Tensor, apart: float) -> Tensor:
    """Opacity of each of the two that a Gaussian becomes, the smaller root of the equation above.

    Args:
        opacities: Of the one, in [0, 1], float64.
        apart: d, in (0, ``SPLIT_APART_MOST``].
    """
    narrower = math.sqrt(1.0 - apart**2)
    shared = math.exp(-((apart / narrower) ** 2)) / math.sqrt(2.0)
    return opacities / narrower / (1.0 + (1.0 - shared * opacities / narrower).sqrt())


@torch.no_grad()
def split_onto(
    gaussians: Gaussians, optimizers: Optimizers, moved: Tensor, sources: Tensor, apart: float, least: float
) -> None:
    """Let Gaussians become the second halves of others. All moments of both start again from zero.

    Args:
        moved: Indices of those that become second halves, shape [n].
        sources: Indices of those that are split, all different, none of them moved itself, shape [n].
        apart: d of the halves' distance, in (0, ``SPLIT_APART_MOST``].
        least: Opacity below which none is lowered.
    """
    shift = _halve(gaussians, sources, apart, least)
    copy_onto(gaussians, optimizers, moved, sources)
    _part(gaussians, sources, moved, shift)


@torch.no_grad()
def split(gaussians: Gaussians, optimizers: Optimizers, sources: Tensor, apart: float, least: float) -> None:
    """Let Gaussians become two, of which the second is appended.

    Args:
        sources: Indices of those that are split, all different, shape [n].
        apart: d of the halves' distance, in (0, ``SPLIT_APART_MOST``].
    """
    shift = _halve(gaussians, sources, apart, least)
    clear_moments(gaussians, optimizers, sources)
    first_new = len(gaussians)
    append_copies(gaussians, optimizers, sources)
    _part(gaussians, sources, torch.arange(first_new, len(gaussians), device=sources.device), shift)


def _halve(gaussians: Gaussians, sources: Tensor, apart: float, least: float) -> Tensor:
    """Give each source size and opacities of one half; where the halves go from its mean, [n, 3]."""
    scales = gaussians.scales[sources]
    longest, axis = scales.max(dim=-1, keepdim=True)
    offsets = torch.zeros_like(scales).scatter_(1, axis, apart * longest)
    shift = rotate(gaussians.quats[sources], offsets)
    gaussians.log_scales[sources, axis[:, 0]] += 0.5 * math.log1p(-(apart**2))
    lower_opacities(gaussians, sources, lambda opacities: halves_opacities(opacities, apart), least)
    return shift


def _part(gaussians: Gaussians, first: Tensor, second: Tensor, shift: Tensor) -> None:
    gaussians.means[first] += shift
    gaussians.means[second] -= shift
