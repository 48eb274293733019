"""Which Gaussians may go: those that matter least, as many as the training images do not miss."""

from collections.abc import Mapping

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.budget.image_change import ImageChange, most_within
from thermosplat.training.density.gaussian_ops import Optimizers, opacities_restored, prune

_INVISIBLE = -30.0
"""Logit of an opacity that no renderer draws."""


def least(scores: Tensor, count: int) -> Tensor:
    """Mask of the ``count`` Gaussians of least score, of scores [N]."""
    mask = torch.zeros_like(scores, dtype=torch.bool)
    mask[torch.argsort(scores, stable=True)[:count]] = True
    return mask


@torch.no_grad()
def dispensable(gaussians: Gaussians, scores: Tensor, change: ImageChange, tolerance: float) -> Tensor:
    """The most Gaussians, least score first, without which the images change by no more than the tolerance.

    Args:
        gaussians: A set of the model that ``change`` renders; it is left as it is.
        scores: What each Gaussian is worth, shape [N].
        change: The images from before.
        tolerance: Largest change (``ImageChange.now``).

    Returns:
        Mask [N].
    """
    everyone = torch.arange(len(gaussians), device=scores.device)
    first = gaussians.logit_opacities.clone()
    others = {name: gaussians.logits_in(name).clone() for name in gaussians.second_opacities}

    def hide(count: int) -> None:
        hidden = least(scores, count)
        masked = {name: logits.masked_fill(hidden, _INVISIBLE) for name, logits in others.items()}
        gaussians.set_opacity_logits(everyone, first.masked_fill(hidden, _INVISIBLE), masked)

    with opacities_restored(gaussians):
        count = most_within(change, len(gaussians) - 1, hide, tolerance)
    return least(scores, count)


def prune_sets(
    gaussian_sets: Mapping[str, Gaussians], optimizers: Mapping[str, Optimizers], removed: Mapping[str, Tensor]
) -> None:
    """Remove Gaussians from several sets, but never all of one.

    Args:
        gaussian_sets: The sets by name.
        removed: Masks [N] by name of the set.
    """
    for name, mask in removed.items():
        if bool(mask.any()) and not bool(mask.all()):
            prune(gaussian_sets[name], optimizers[name], mask)
