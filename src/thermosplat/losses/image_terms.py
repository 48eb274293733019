"""The training loss: what the spectra's formations compare, and smoothness (docs/method.md, equations 9-13).

Images are [H, W, C] in [0, 1]; renders are the raw, unclamped ones.

The SSIM term is 1 - SSIM, as in 3DGS. kornia's ready-made loss is half of that and would halve λ_s silently.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from kornia.losses import total_variation
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.fused.image_loss import ImageTerm, warp_image_loss, warp_image_losses
from thermosplat.image_quality.ssim import ssim_map
from thermosplat.scene.formations.formation import LossTerm, masked
from thermosplat.scene.formations.formation import image_terms as terms_of_image
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import latent_channels

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors


def smoothness(image: Tensor, target: Tensor | None = None) -> Tensor:
    """Mean over pixels and channels of |∂x| + |∂y|, forward differences without wrap-around (equation 12).

    Normalised by H·W·C, as ThermalGaussian does; kornia's own mean would divide each direction by the number of its
    differences instead.

    Args:
        image: Image, shape [H, W, C].
        target: Not looked at.

    Returns:
        The smoothness term, a scalar.
    """
    return total_variation(image.permute(2, 0, 1), reduction="sum").sum() / image.numel()


SPECTRUM_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"smoothness": smoothness}
"""By the field of ``SpectrumConfig`` that weighs it, each loss as a function of the render and its image, [H, W, C].
``losses.image_terms`` calls the term "<spectrum>_<field>"."""


@dataclass(frozen=True)
class ComparedFrame:
    """A rendered frame against its images."""

    losses: dict[str, Tensor]
    """All weighted terms, scalars; the total is their sum."""
    spectra: dict[str, str]
    squared_errors: dict[str, Tensor]
    """Mean squared error of the images clamped to [0, 1], by spectrum; no gradient reaches it."""


def image_loss(render: Tensor, target: Tensor, ssim_lambda: float) -> Tensor:
    """(1 - λ_s) |render - target|_1 + λ_s (1 - SSIM), each the mean over pixels and channels (equation 9).

    Args:
        render: Rendered image, shape [H, W, C], H and W > 5.
        target: Ground truth in [0, 1], shape [H, W, C].
        ssim_lambda: λ_s, the share of the SSIM term, 0 to 1.

    Returns:
        The loss, a scalar.
    """
    term = ImageTerm("image", 1.0, render, target)
    return warp_image_loss(render, target, ssim_lambda) if render.is_cuda else _filtered([term], ssim_lambda)["image"]


def compare_frame(
    rendered: RenderedFrame, frame: "FrameTensors", config: TrainConfig, *, fused: bool | None = None
) -> ComparedFrame:
    """All weighted terms of one frame's loss, and the squared errors of its images.

    A term whose weight is 0, or whose render or target is missing, is not computed and not listed.

    Args:
        fused: By Warp's kernels, all in the same few launches, or by ``ssim_map``, which is held to kornia's. None:
            on CUDA the first, on the CPU, where they are faster, the second.

    Returns:
        Terms in this order: the image of each spectrum by its name, "features_<spectrum>" of each, what formations
        compare beside that, and "<spectrum>_<field>" of each of ``SPECTRUM_LOSSES``.
    """
    asked = _losses_of_spectra(rendered, frame, config)
    terms = _of_images_first(asked)
    if fused is None:
        fused = bool(terms) and all(term.image.is_cuda for term in terms)
    ssim_lambda = config.loss.ssim_lambda
    smoothed = {name: one.smoothness for name, one in config.modelled.items() if one.smoothness > 0}
    found = _fused(terms, ssim_lambda, smoothed) if fused else _Found(_filtered(terms, ssim_lambda), {})
    losses = {term.name: found.losses[term.name] for term in terms}
    losses |= {one.name: one.loss for losses in asked.values() for one in losses if isinstance(one, LossTerm)}
    owners = {one.name: name for name, losses in asked.items() for one in losses}
    spectra = {term: owners[term] for term in losses}
    errors = {}
    for name, image, view, target in _seen(rendered, frame, config):
        known = found.squared_errors.get(name) if view.mask is None else None
        errors[name] = squared_error(image, target, view.mask) if known is None else known
    for field, loss_of in SPECTRUM_LOSSES.items():
        for name, image, view, target in _seen(rendered, frame, config):
            weight, term = getattr(config.modelled[name], field), f"{name}_{field}"
            if weight > 0:
                pair = (image, target) if view.mask is None else masked(image, target, view.mask)
                loss = found.losses.get(term)
                losses[term] = weight * loss_of(*pair) if loss is None else loss
                spectra[term] = name
    return ComparedFrame(losses, spectra, errors)


def _seen(
    rendered: RenderedFrame, frame: "FrameTensors", config: TrainConfig
) -> Iterator[tuple[str, Tensor, "ViewTensors", Tensor]]:
    """The spectra that are both rendered and photographed: name, render, view and its image."""
    for name in config.modelled:
        image, view = rendered.images.get(name), frame.views.get(name)
        if image is not None and view is not None and view.image is not None:
            yield name, image, view, view.image


@torch.no_grad()
def squared_error(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean squared difference of an image clamped to [0, 1] from its target, a scalar; no gradient reaches it.

    Args:
        image: [H, W, C].
        mask: bool [H, W], which pixels count; None: all.
    """
    squares = (image.clamp(0.0, 1.0) - target).square()
    if mask is None:
        return squares.mean()
    return torch.where(mask[..., None], squares, 0.0).sum() / (mask.sum().clamp(min=1) * image.shape[-1])


def image_terms(rendered: RenderedFrame, frame: "FrameTensors", config: TrainConfig) -> list[ImageTerm]:
    """The image losses that apply to a frame (equations 10 and 11): first those of images, then those of features.

    Args:
        config: Weights; what has none is left out.
    """
    return _of_images_first(_losses_of_spectra(rendered, frame, config))


def _losses_of_spectra(
    rendered: RenderedFrame, frame: "FrameTensors", config: TrainConfig
) -> dict[str, list[ImageTerm | LossTerm]]:
    """What each spectrum is compared by, as its formation says."""
    found: dict[str, list[ImageTerm | LossTerm]] = {}
    for name, settings in config.modelled.items():
        view, formation = frame.views.get(name), rendered.formations.get(name)
        if view is None:
            continue
        if formation is None:
            first, _ = latent_channels(config.modelled)[name]
            found[name] = terms_of_image(name, first, rendered, view, settings, config.loss)
        else:
            found[name] = formation.losses(rendered, view, settings, config.loss)
    return found


def _of_images_first(asked: dict[str, list[ImageTerm | LossTerm]]) -> list[ImageTerm]:
    """The image losses of all spectra, before those of features, which are called by another name."""
    terms = [one for losses in asked.values() for one in losses if isinstance(one, ImageTerm)]
    return sorted(terms, key=lambda term: term.name not in asked)


@dataclass(frozen=True)
class _Found:
    """What comes of comparing images: weighted losses by name, and squared errors by name."""

    losses: dict[str, Tensor]
    squared_errors: dict[str, Tensor]


def _fused(terms: Sequence[ImageTerm], ssim_lambda: float, smoothed: dict[str, float]) -> _Found:
    """All terms of images of one size by one call of Warp's kernels, and with one of them its smoothness.

    Args:
        ssim_lambda: λ_s.
        smoothed: Weight of the smoothness by spectrum; the kernels take the first of a call.
    """
    losses: dict[str, Tensor] = {}
    errors: dict[str, Tensor] = {}
    for size in dict.fromkeys(term.image.shape[:2] for term in terms):
        members = [term for term in terms if term.image.shape[:2] == size]
        names = [term.name for term in members]
        first = next((name for name in names if name in smoothed), None)
        found = warp_image_losses(
            members,
            ssim_lambda,
            smoothed=None if first is None else names.index(first),
            smoothness=0.0 if first is None else smoothed[first],
        )
        losses |= dict(zip(names, found.losses, strict=True))
        errors |= dict(zip(names, found.squared_errors, strict=True))
        if first is not None:
            losses[f"{first}_smoothness"] = found.smoothness
    return _Found(losses, errors)


def _filtered(terms: Sequence[ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    """Weighted image losses by name, by ``ssim_map``."""
    losses = _unweighted(terms, ssim_lambda)
    for term in terms:
        if term.squared > 0:
            squares = (term.render - term.target).square().mean()
            losses[term.name] = losses[term.name] + (1 - ssim_lambda) * term.squared * squares
    return {term.name: term.weight * losses[term.name] for term in terms}


def _unweighted(terms: Sequence[ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    """Image losses by name, with one call for the channels of all images of one size.

    L1 and SSIM treat channels separately, so stacking the channels of several images changes no value; one call for ten
    channels of 200x150 takes four fifths of the time of four small ones.
    """
    losses: dict[str, Tensor] = {}
    for size in dict.fromkeys(term.render.shape[:2] for term in terms):
        members = [term for term in terms if term.render.shape[:2] == size]
        # Channels first before they are joined: on the CPU that is ten times faster than joining the last dimension.
        renders = torch.cat([term.render.permute(2, 0, 1) for term in members])
        targets = torch.cat([term.target.permute(2, 0, 1) for term in members])
        by_channel = (1 - ssim_lambda) * (renders - targets).abs().mean(dim=(1, 2))
        if ssim_lambda > 0:
            by_channel = by_channel + ssim_lambda * (1 - ssim_map(renders, targets).mean(dim=(1, 2)))
        for term, values in zip(members, by_channel.split([term.render.shape[-1] for term in members])):
            losses[term.name] = values.mean()
    return losses


def balanced_losses(
    losses: Mapping[str, Tensor], spectra: Mapping[str, str], num_gaussians: Mapping[str, int]
) -> dict[str, Tensor]:
    """Loss terms, each multiplied by the share of all Gaussians that the other spectra have, mean over those.

    ThermalGaussian's regularisation of MSMG: the larger a spectrum's set, the less its losses weigh, and with them the
    gradients that densification compares with its threshold, so that sets hold each other's growth in check. (Adam's
    updates hardly depend on the scale of a loss.)

    Args:
        spectra: The spectrum of each term that is one spectrum's.
        num_gaussians: Gaussians by spectrum, whose set it is; two at least.

    Returns:
        The same terms. With two sets of one size every factor is 1/2.
    """
    total, others = sum(num_gaussians.values()), len(num_gaussians) - 1
    factors = {name: (total - count) / (total * others) for name, count in num_gaussians.items()}
    return {name: factors[spectra[name]] * loss if name in spectra else loss for name, loss in losses.items()}


LEAST_ALPHA = 0.5
"""Accumulated opacity of pixels that have a depth."""


def swept_depth_loss(log_depth: Tensor, alpha: Tensor, target: Tensor, limit: float) -> Tensor:
    """Mean over all pixels of |Σ w log z / Σ w - target|, at most a limit each; 0 where one of them is unknown.

    Absolute differences let a surface settle at the median of what the views' sweeps say of it.

    Args:
        log_depth: Blended log z, Σ w log z, [H, W, 1]. Receives a gradient.
        alpha: Accumulated opacity Σ w, [H, W, 1]. Receives a gradient.
        target: log z of the sweep, [H, W]; NaN where it is unknown.
        limit: Difference from which on more does not count: the sweep found another surface, or is wrong.

    Returns:
        The loss, a scalar.
    """
    known = (alpha[..., 0] > LEAST_ALPHA) & ~target.isnan()
    mean = log_depth[..., 0] / alpha[..., 0].clamp(min=LEAST_ALPHA)
    apart = (mean - target.nan_to_num()).abs().clamp(max=limit)
    return torch.where(known, apart, 0.0).mean()
