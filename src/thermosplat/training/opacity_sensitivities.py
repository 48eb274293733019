"""How much images change with each Gaussian's opacity, and so by leaving the Gaussian out.

A blended image is linear in the opacity o of one Gaussian (equation 1), so leaving out that Gaussian alone changes it
by exactly -o ∂A/∂o, whatever lies behind: little where it has the colour of what it hides. The squared change of all
pixels, o² Σ_p (∂I_p/∂o)², therefore says what a Gaussian is worth to the images, decoders included (to first order).
With random signs s_p = ±1 the gradient of Σ_p s_p I_p is Σ_p s_p ∂I_p/∂o, whose square has the expected value
Σ_p (∂I_p/∂o)² (Hutchinson 1990): one backward pass a view for all Gaussians and both spectra.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.gaussians import Gaussians
from thermosplat.model import SceneModel
from thermosplat.training.gaussian_ops import opacities_restored

_OPAQUE = 0.99
"""Opacities are looked at no higher than this: alpha is clamped at 0.999, where an image no longer changes with it."""


def opacity_sensitivities(
    model: SceneModel,
    frames: Iterable[FrameTensors],
    sh_degree: int,
    weights: Mapping[str, float],
    *,
    deterministic: bool = False,
) -> dict[str, Tensor]:
    """Sums over pixels of squared derivatives of the images with respect to opacities.

    Args:
        model: The scene.
        frames: The training frames.
        sh_degree: Degree of the spherical harmonics in use.
        weights: What a squared change of an image counts, by "rgb" and "thermal".
        deterministic: As the rasterizer's: the same bits at every call.

    Returns:
        By name of the set, shape [2, N]: with respect to α and to α_t, weighted; in a set with one opacity all in the
        first row. Estimated with the same signs at every call.
    """
    device = model.background.device
    signs = torch.Generator(device).manual_seed(0)  # drawn where they are used: a frame has a million
    found = {name: torch.zeros(2, len(model.gaussians(name)), device=device) for name in model.gaussian_sets}
    with _translucent(model):
        for frame in frames:
            for name, gradients in _gradients(model, frame, sh_degree, weights, signs, deterministic).items():
                found[name] += gradients.square()
    return found


def removal_effects(gaussians: Gaussians, sensitivities: Tensor) -> Tensor:
    """Squared change of the images by leaving out each Gaussian alone, shape [N].

    Args:
        gaussians: A set.
        sensitivities: Its opacities', shape [2, N].
    """
    opacities = torch.stack([gaussians.opacities, gaussians.thermal_opacities]).detach()
    return (opacities.square() * sensitivities).sum(dim=0)


def offset_effects(gaussians: Gaussians, sensitivities: Tensor) -> Tensor:
    """Squared change of the thermal images by giving each Gaussian its visible opacity in them, shape [N].

    Args:
        gaussians: A set with two opacities.
        sensitivities: Its opacities', shape [2, N].
    """
    return (gaussians.thermal_opacities - gaussians.opacities).detach().square() * sensitivities[1]


@torch.enable_grad()
def _gradients(
    model: SceneModel,
    frame: FrameTensors,
    sh_degree: int,
    weights: Mapping[str, float],
    signs: torch.Generator,
    deterministic: bool,
) -> dict[str, Tensor]:
    """Derivatives of one frame's images, added with random signs, with respect to opacities [2, N], by set."""
    rendered = model.render(
        frame.rgb, frame.thermal, sh_degree=sh_degree, aligned=frame.aligned, deterministic=deterministic
    )
    images = ((rendered.rgb, weights.get("rgb")), (rendered.thermal, weights.get("thermal")))
    total = model.background.new_zeros(())
    for image, weight in images:
        if image is not None and weight is not None:
            drawn = 2 * torch.randint(2, image.shape, generator=signs, dtype=torch.int8, device=image.device) - 1
            total = total + weight**0.5 * (image * drawn.to(image)).sum()
    logits = {name: _logits(model.gaussians(name)) for name in model.gaussian_sets}
    every = [tensor for tensors in logits.values() for tensor in tensors]
    if not total.requires_grad:
        return {}
    found = iter(torch.autograd.grad(total, every, allow_unused=True, materialize_grads=True))
    return {
        name: _of_opacities(model.gaussians(name), [next(found) for _ in tensors]) for name, tensors in logits.items()
    }


def _logits(gaussians: Gaussians) -> list[Tensor]:
    """What opacities are stored as."""
    names = ("logit_opacities", "thermal_opacity_offsets", "logit_thermal_opacities")
    stored = dict(gaussians.named_parameters())
    return [stored[name] for name in names if name in stored]


def _of_opacities(gaussians: Gaussians, gradients: list[Tensor]) -> Tensor:
    """Derivatives with respect to α and α_t [2, N], of those with respect to what is stored; dα / d logit is α(1-α)."""
    visible, thermal = gaussians.opacities.detach(), gaussians.thermal_opacities.detach()
    of_logits = gradients[0]
    of_thermal = gradients[1] if len(gradients) > 1 else torch.zeros_like(of_logits)
    if "thermal_opacity_offsets" in dict(gaussians.named_parameters()):
        of_logits = of_logits - of_thermal  # the visible logit moves both
    tiny = torch.finfo(visible.dtype).tiny
    by_logit = torch.stack([visible * (1.0 - visible), thermal * (1.0 - thermal)]).clamp(min=tiny)
    return torch.stack([of_logits, of_thermal]) / by_logit


@contextmanager
def _translucent(model: SceneModel) -> Iterator[None]:
    """While this is open no opacity is above ``_OPAQUE``."""
    limit = torch.logit(torch.tensor(_OPAQUE)).item()
    with ExitStack() as restored:
        for name in model.gaussian_sets:
            gaussians = model.gaussians(name)
            restored.enter_context(opacities_restored(gaussians))
            everyone = torch.arange(len(gaussians), device=gaussians.means.device)
            visible, thermal = gaussians.logit_opacities.detach(), gaussians.thermal_logits.detach()
            gaussians.set_opacity_logits(everyone, visible.clamp(max=limit), thermal.clamp(max=limit))
        yield
