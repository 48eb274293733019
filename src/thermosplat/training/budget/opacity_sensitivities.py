"""How much images change with each Gaussian's opacity, and so by leaving the Gaussian out.

A blended image is linear in the opacity o of one Gaussian (equation 1), so leaving out that Gaussian alone changes it
by exactly -o ∂A/∂o, whatever lies behind: little where it has the colour of what it hides. The squared change of all
pixels, o² Σ_p (∂I_p/∂o)², therefore says what a Gaussian is worth to the images, decoders included (to first order).
With random signs s_p = ±1 the gradient of Σ_p s_p I_p is Σ_p s_p ∂I_p/∂o, whose square has the expected value
Σ_p (∂I_p/∂o)² (Hutchinson 1990): one backward pass per view for all Gaussians and all spectra.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.training.density.gaussian_ops import opacities_restored

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
        frames: The training frames.
        weights: What a squared change of an image counts, by spectrum.
        deterministic: As the rasterizer's: the same bits at every call.

    Returns:
        By name of the set, shape [1 + S, N]: with respect to α and to each of its S second opacities, weighted.
        Estimated with the same signs at every call.
    """
    device = model.background.device
    signs = torch.Generator(device).manual_seed(0)  # drawn where they are used: a frame has a million
    sets = {name: model.gaussians(name) for name in model.gaussian_sets}
    found = {
        name: torch.zeros(1 + len(gaussians.second_opacities), len(gaussians), device=device)
        for name, gaussians in sets.items()
    }
    with _translucent(model):
        for frame in frames:
            for name, gradients in _gradients(model, frame, sh_degree, weights, signs, deterministic).items():
                found[name] += gradients.square()
    return found


def removal_effects(gaussians: Gaussians, sensitivities: Tensor) -> Tensor:
    """Squared change of the images by leaving out each Gaussian alone, shape [N].

    Args:
        gaussians: A set.
        sensitivities: Its opacities', shape [1 + S, N].
    """
    return (_every_opacity(gaussians).square() * sensitivities).sum(dim=0)


def offset_effects(gaussians: Gaussians, spectrum: str, sensitivities: Tensor) -> Tensor:
    """Squared change of a spectrum's images by giving each Gaussian α in them, shape [N].

    Args:
        gaussians: A set with a second opacity in that spectrum.
        sensitivities: The set's opacities', shape [1 + S, N].
    """
    row = 1 + gaussians.second_opacities.index(spectrum)
    return (gaussians.opacities_in(spectrum) - gaussians.opacities).detach().square() * sensitivities[row]


def _every_opacity(gaussians: Gaussians) -> Tensor:
    """α and the second opacities, [1 + S, N]."""
    return torch.stack([gaussians.opacities, *map(gaussians.opacities_in, gaussians.second_opacities)]).detach()


@torch.enable_grad()
def _gradients(
    model: SceneModel,
    frame: FrameTensors,
    sh_degree: int,
    weights: Mapping[str, float],
    signs: torch.Generator,
    deterministic: bool,
) -> dict[str, Tensor]:
    """Derivatives of one frame's images, added with random signs, with respect to opacities [1 + S, N], by set."""
    rendered = model.render(
        frame.views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras, deterministic=deterministic
    )
    total = model.background.new_zeros(())
    for name in model.spectra:
        weight = weights.get(name)
        if name in rendered.images and weight is not None:
            image = rendered.formations[name].graded(rendered)
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
    """What opacities are stored as: α first, then the second ones."""
    stored = (gaussians.stored_opacity(spectrum).values for spectrum in gaussians.second_opacities)
    return [gaussians.logit_opacities, *(values for values in stored if values is not None)]


def _of_opacities(gaussians: Gaussians, gradients: list[Tensor]) -> Tensor:
    """Derivatives with respect to opacities [1 + S, N], of those by what is stored; dα / d logit is α(1-α)."""
    of_logits, *of_others = gradients
    for spectrum, gradient in zip(gaussians.second_opacities, of_others, strict=True):
        if gaussians.stored_opacity(spectrum).is_offset:
            of_logits = of_logits - gradient  # α's logit moves both
    opacities = _every_opacity(gaussians)
    by_logit = (opacities * (1.0 - opacities)).clamp(min=torch.finfo(opacities.dtype).tiny)
    return torch.stack([of_logits, *of_others]) / by_logit


@contextmanager
def _translucent(model: SceneModel) -> Iterator[None]:
    """While this is open no opacity is above ``_OPAQUE``."""
    limit = torch.logit(torch.tensor(_OPAQUE)).item()
    with ExitStack() as restored:
        for name in model.gaussian_sets:
            gaussians = model.gaussians(name)
            restored.enter_context(opacities_restored(gaussians))
            everyone = torch.arange(len(gaussians), device=gaussians.means.device)
            first = gaussians.logit_opacities.detach().clamp(max=limit)
            others = {name: gaussians.logits_in(name).detach().clamp(max=limit) for name in gaussians.second_opacities}
            gaussians.set_opacity_logits(everyone, first, others)
        yield
