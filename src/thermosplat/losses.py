"""The training loss: image terms of both spectra, feature terms, thermal smoothness (docs/method.md, equations 9-13).

Images are [H, W, C] in [0, 1]; renders are the raw, unclamped ones.

The SSIM term is 1 - SSIM, as in 3DGS. kornia's ready-made loss is half of that and would halve λ_s silently.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from kornia.losses import total_variation
from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.rendered_frame import RenderedFrame
from thermosplat.ssim import ssim_map
from thermosplat.warp_image_loss import ImageTerm, warp_image_loss, warp_image_losses

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import FrameTensors


@dataclass(frozen=True)
class Comparison:
    """A rendered frame against its images."""

    losses: dict[str, Tensor]
    """All weighted terms, scalars; the total is their sum."""
    squared_errors: dict[str, Tensor]
    """Mean squared error of the images clamped to [0, 1], by modality; no gradient reaches it."""


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


def frame_losses(
    rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig, *, fused: bool | None = None
) -> dict[str, Tensor]:
    """All weighted terms of one frame's loss; the total is their sum.

    A term whose weight is 0, or whose render or target is missing, is not computed and not listed.

    Args:
        rendered: What the model rendered of the frame.
        frame: The ground truth.
        config: The weights.
        fused: By Warp's kernels, all in the same few launches, or by ``ssim_map``, which is held to kornia's. None:
            on CUDA the first, on the CPU, where they are faster, the second.

    Returns:
        Scalars by term, in this order: "rgb", "thermal", "features_rgb", "features_thermal", "thermal_smoothness".
    """
    return _compared(rendered, frame, config, fused).losses


def compare_frame(
    rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig, *, fused: bool | None = None
) -> Comparison:
    """The terms of :func:`frame_losses`, and the squared errors of the images, which cost the fused kernels nothing.

    Args:
        rendered: As in ``frame_losses``.
        frame: As in ``frame_losses``.
        config: As in ``frame_losses``.
        fused: As in ``frame_losses``.
    """
    compared = _compared(rendered, frame, config, fused)
    errors = {}
    for modality, image, view in (("rgb", rendered.rgb, frame.rgb), ("thermal", rendered.thermal, frame.thermal)):
        if image is not None and view is not None and view.image is not None:
            known = compared.squared_errors.get(modality)
            errors[modality] = _squared_error(image, view.image) if known is None else known
    return Comparison(compared.losses, errors)


def _compared(rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig, fused: bool | None) -> Comparison:
    """All losses, and those squared errors that come with them."""
    terms = image_terms(rendered, frame, config)
    if fused is None:
        fused = bool(terms) and all(term.image.is_cuda for term in terms)
    found = _fused(terms, config) if fused else Comparison(_filtered(terms, config.ssim_lambda), {})
    losses = {term.name: found.losses[term.name] for term in terms}
    if rendered.thermal is not None and config.thermal_smoothness > 0:
        smooth = found.losses.get("thermal_smoothness")
        losses["thermal_smoothness"] = (
            config.thermal_smoothness * smoothness(rendered.thermal) if smooth is None else smooth
        )
    return Comparison(losses, found.squared_errors)


@torch.no_grad()
def _squared_error(image: Tensor, target: Tensor) -> Tensor:
    return (image.clamp(0.0, 1.0) - target).square().mean()


def smoothness(image: Tensor) -> Tensor:
    """Mean over pixels and channels of |∂x| + |∂y|, forward differences without wrap-around (equation 12).

    Normalised by H·W·C, as ThermalGaussian does; kornia's own mean would divide each direction by the number of its
    differences instead.

    Args:
        image: Image, shape [H, W, C].

    Returns:
        The smoothness term, a scalar.
    """
    return total_variation(image.permute(2, 0, 1), reduction="sum").sum() / image.numel()


def image_terms(rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig) -> list[ImageTerm]:
    """The image losses that apply to a frame (equations 10 and 11).

    Args:
        rendered: The render.
        frame: The frame.
        config: Weights; what has none is left out.
    """
    rgb = frame.rgb.image if frame.rgb is not None else None
    thermal = frame.thermal.image if frame.thermal is not None else None
    intensity = frame.thermal.intensity if frame.thermal is not None else None
    scalar = intensity[..., None] if intensity is not None else None
    noise = config.thermal_charbonnier
    on_features = config.features * config.features_rgb, config.features * config.features_thermal
    candidates: list[tuple[str, float, Tensor | None, Tensor | None, int, float]] = [
        ("rgb", config.rgb, rendered.rgb, rgb, 0, 0.0),
        ("thermal", config.thermal, rendered.thermal, thermal, 0, noise),
        ("features_rgb", on_features[0], rendered.visible_features, rgb, 0, 0.0),
        ("features_thermal", on_features[1], rendered.thermal_features, scalar, 3, noise),
    ]
    return [
        ImageTerm(name, weight, image, target, first, epsilon)
        for name, weight, image, target, first, epsilon in candidates
        if weight > 0 and image is not None and target is not None
    ]


def charbonnier(differences: Tensor, epsilon: float) -> Tensor:
    """Mean of sqrt(d² + ε²) - ε: d² / 2ε for differences well below ε, |d| - ε for those well above it.

    Args:
        differences: Any shape.
        epsilon: ε > 0, in the differences' units.
    """
    return torch.sqrt(differences.square() + epsilon**2).mean() - epsilon


def _fused(terms: list[ImageTerm], config: LossConfig) -> Comparison:
    """All terms of images of one size by one call of Warp's kernels, and with the thermal one its smoothness."""
    losses: dict[str, Tensor] = {}
    errors: dict[str, Tensor] = {}
    for size in dict.fromkeys(term.image.shape[:2] for term in terms):
        members = [term for term in terms if term.image.shape[:2] == size]
        names = [term.name for term in members]
        smoothed = names.index("thermal") if "thermal" in names and config.thermal_smoothness > 0 else None
        found = warp_image_losses(members, config.ssim_lambda, smoothed=smoothed, smoothness=config.thermal_smoothness)
        losses |= dict(zip(names, found.losses, strict=True))
        errors |= dict(zip(names, found.squared_errors, strict=True))
        if smoothed is not None:
            losses["thermal_smoothness"] = found.smoothness
    return Comparison(losses, errors)


def _filtered(terms: list[ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    """Weighted image losses by name, by ``ssim_map``."""
    losses = _unweighted([term for term in terms if term.charbonnier == 0], ssim_lambda)
    robust = [term for term in terms if term.charbonnier > 0]
    structural = _unweighted(robust, 1.0)  # 1 - SSIM alone
    for term in robust:
        difference = charbonnier(term.render - term.target, term.charbonnier)
        losses[term.name] = (1 - ssim_lambda) * difference + ssim_lambda * structural[term.name]
    return {term.name: term.weight * losses[term.name] for term in terms}


def _unweighted(terms: list[ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
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
