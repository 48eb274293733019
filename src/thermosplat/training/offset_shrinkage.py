"""Thermal opacity offsets that become zero where decoupling buys nothing.

First all are held down by the proximal step of an L1 penalty, Δ ← sign(Δ) max(|Δ| - λ r, 0) after every update of rate
r (iterative soft thresholding, Daubechies et al. 2004). Adam moves an offset by up to r a step where its gradient keeps
its sign and by less where it is noise, so λ is compared with |mean gradient| / root mean square gradient, whatever the
scale of the loss. Adam's noise alone keeps offsets from staying at zero, so then, once, those that the training images
do not miss become zero for good, and the others are trained on without the penalty, which had made them too small.
"""

import torch
from torch import Tensor

from thermosplat.gaussians import Gaussians
from thermosplat.training.gaussian_ops import Optimizers
from thermosplat.training.image_change import ImageChange, most_within
from thermosplat.training.pruning import least


@torch.no_grad()
def shrink_offsets(gaussians: Gaussians, optimizers: Optimizers, amount: float, blocked: Tensor) -> None:
    """Do one proximal step. Nothing here waits for the device.

    Args:
        gaussians: A set; nothing happens where it has no offsets, or this step did not train them.
        optimizers: Its optimizers, which have made their update.
        amount: λ, at least 0.
        blocked: Scalar, 1 where this step must change nothing.
    """
    if not _trained(gaussians):
        return
    offsets = gaussians.thermal_opacity_offsets
    threshold = torch.where(blocked == 0, amount * optimizers["thermal_opacity_offsets"].param_groups[0]["lr"], 0.0)
    offsets.sub_(offsets.clamp(-threshold, threshold))  # half the passes of sign(Δ) max(|Δ| - λ r, 0), the same bits


@torch.no_grad()
def idle_offsets(gaussians: Gaussians, effects: Tensor, change: ImageChange, tolerance: float) -> Tensor:
    """The most offsets, least effect first, without which the images change by no more than the tolerance.

    Args:
        gaussians: A set with offsets, of the model that ``change`` renders; it is left as it is.
        effects: What each offset does (``opacity_sensitivities.offset_effects``), shape [N].
        change: The images from before.
        tolerance: Largest change (``ImageChange.now``).

    Returns:
        Mask [N].
    """
    offsets = gaussians.thermal_opacity_offsets
    saved = offsets.clone()

    def drop(count: int) -> None:
        offsets.copy_(saved.masked_fill(least(effects, count), 0.0))

    try:
        count = most_within(change, len(effects), drop, tolerance)
    finally:
        offsets.copy_(saved)
    return least(effects, count)


@torch.no_grad()
def drop_offsets(gaussians: Gaussians, optimizers: Optimizers, dropped: Tensor) -> None:
    """Set offsets to zero; Adam forgets those.

    Args:
        gaussians: A set with offsets.
        optimizers: Its optimizers.
        dropped: Mask [N].
    """
    offsets = gaussians.thermal_opacity_offsets
    offsets.masked_fill_(dropped, 0.0)
    for key, moment in optimizers["thermal_opacity_offsets"].state.get(offsets, {}).items():
        if key != "step":
            moment.masked_fill_(dropped, 0.0)


@torch.no_grad()
def hold_zeros(gaussians: Gaussians) -> None:
    """Before an update: offsets that are zero get no gradient, and so stay zero.

    Args:
        gaussians: A set; nothing happens where it has no offsets, or this step does not train them.
    """
    if _trained(gaussians):
        gaussians.thermal_opacity_offsets.grad.mul_(gaussians.thermal_opacity_offsets != 0)  # type: ignore[union-attr]


def _trained(gaussians: Gaussians) -> bool:
    has_offsets = "thermal_opacity_offsets" in dict(gaussians.named_parameters())
    return has_offsets and gaussians.thermal_opacity_offsets.grad is not None
