"""Opacity offsets that become zero where decoupling buys nothing.

First all are held down by the proximal step of an L1 penalty, Δ ← sign(Δ) max(|Δ| - λ r, 0) after every update of rate
r (iterative soft thresholding, Daubechies et al. 2004). Adam moves an offset by up to r a step where its gradient keeps
its sign and by less where it is noise, so λ is compared with |mean gradient| / root mean square gradient, whatever the
scale of the loss. Adam's noise alone keeps offsets from staying at zero, so then, once, those that the training images
do not miss become zero for good, and the others are trained on without the penalty, which had made them too small.
"""

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians, offsets_name
from thermosplat.training.budget.image_change import ImageChange, most_within
from thermosplat.training.budget.pruning import least
from thermosplat.training.density.gaussian_ops import Optimizers


@torch.no_grad()
def shrink_offsets(gaussians: Gaussians, optimizers: Optimizers, amount: float, blocked: Tensor) -> None:
    """Do one proximal step. Nothing here waits for the device.

    Args:
        gaussians: A set; nothing happens where it has no offsets, or this step did not train them.
        optimizers: Its optimizers, which have made their update.
        amount: λ, at least 0.
        blocked: Scalar, 1 where this step must change nothing.
    """
    for name in trained_offsets(gaussians):
        offsets = gaussians.get_parameter(name)
        threshold = torch.where(blocked == 0, amount * optimizers[name].param_groups[0]["lr"], 0.0)
        offsets.sub_(offsets.clamp(-threshold, threshold))  # half the passes of sign(Δ) max(|Δ| - λ r, 0), same bits


@torch.no_grad()
def idle_offsets(gaussians: Gaussians, spectrum: str, effects: Tensor, change: ImageChange, tolerance: float) -> Tensor:
    """The most offsets, least effect first, without which the images change by no more than the tolerance.

    Args:
        gaussians: A set with offsets, of the model that ``change`` renders; it is left as it is.
        spectrum: The spectrum whose offsets they are.
        effects: What each offset does (``opacity_sensitivities.offset_effects``), shape [N].
        change: The images from before.
        tolerance: Largest change (``ImageChange.now``).

    Returns:
        Mask [N].
    """
    offsets = gaussians.get_parameter(offsets_name(spectrum))
    saved = offsets.clone()

    def drop(count: int) -> None:
        offsets.copy_(saved.masked_fill(least(effects, count), 0.0))

    try:
        count = most_within(change, len(effects), drop, tolerance)
    finally:
        offsets.copy_(saved)
    return least(effects, count)


@torch.no_grad()
def drop_offsets(gaussians: Gaussians, spectrum: str, optimizers: Optimizers, dropped: Tensor) -> None:
    """Set offsets to zero; Adam forgets those.

    Args:
        gaussians: A set with offsets.
        spectrum: The spectrum whose offsets they are.
        dropped: Mask [N].
    """
    name = offsets_name(spectrum)
    offsets = gaussians.get_parameter(name)
    offsets.masked_fill_(dropped, 0.0)
    for key, moment in optimizers[name].state.get(offsets, {}).items():
        if key != "step":
            moment.masked_fill_(dropped, 0.0)


@torch.no_grad()
def hold_zeros(gaussians: Gaussians) -> None:
    """Before an update: offsets that are zero get no gradient, and so stay zero.

    Args:
        gaussians: A set; nothing happens where it has no offsets, or this step does not train them.
    """
    for name in trained_offsets(gaussians):
        offsets = gaussians.get_parameter(name)
        offsets.grad.mul_(offsets != 0)  # type: ignore[union-attr]


def offset_spectra(gaussians: Gaussians) -> list[str]:
    """The spectra whose opacity is stored as offsets."""
    return [spectrum for spectrum in gaussians.second_opacities if gaussians.stored_opacity(spectrum).is_offset]


def trained_offsets(gaussians: Gaussians) -> list[str]:
    """Names of the offsets that this step trained."""
    names = map(offsets_name, offset_spectra(gaussians))
    return [name for name in names if gaussians.get_parameter(name).grad is not None]
