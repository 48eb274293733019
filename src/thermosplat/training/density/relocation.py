"""Gaussians that become several in one place without the image changing: what 3DGS-MCMC adds and moves Gaussians by.

What becomes of their opacities and sizes: ``fused.relocation``.
"""

from collections.abc import Callable
from functools import reduce

import torch
from torch import Tensor

from thermosplat.fused.relocation import MOST_COPIES, scale_factors, shared_opacities
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers, append_copies, clear_moments, copy_onto

_EPSILON = 1e-6
"""Opacities stay this far from 0 and 1, where their logits are infinite."""


@torch.no_grad()
def relocate(gaussians: Gaussians, optimizers: Optimizers, moved: Tensor, sources: Tensor, least: float) -> None:
    """Move Gaussians onto others, which share their opacity with them. All moments of both start again from zero.

    Args:
        moved: Indices of those that move, shape [n].
        sources: Indices of those they move to, none of them moved itself; repeated ones share with several. [n].
    """
    _share(gaussians, sources, least)
    copy_onto(gaussians, optimizers, moved, sources)


@torch.no_grad()
def add(gaussians: Gaussians, optimizers: Optimizers, sources: Tensor, least: float) -> None:
    """Append Gaussians in the places of others, which share their opacity with them.

    Args:
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
        indices: Which, int64, shape [n].
        lowered: What becomes of opacities in [0, 1], float64, shape [n].
        least: Opacity below which none falls that was not there.
    """

    def new_logits(logits: Tensor) -> Tensor:
        opacities = logits[indices].double().sigmoid()
        return torch.logit(torch.maximum(lowered(opacities), opacities.clamp(max=least)), eps=_EPSILON)

    others = {name: new_logits(gaussians.logits_in(name)) for name in gaussians.second_opacities}
    gaussians.set_opacity_logits(indices, new_logits(gaussians.logit_opacities), others)
