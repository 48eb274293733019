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
from thermosplat.warp_image_loss import warp_image_loss

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import FrameTensors


@dataclass(frozen=True)
class _ImageTerm:
    """One weighted image loss L(render, target)."""

    name: str
    weight: float
    render: Tensor  # [H, W, C]
    target: Tensor  # [H, W, C]
    charbonnier: float = 0.0


def image_loss(render: Tensor, target: Tensor, ssim_lambda: float) -> Tensor:
    """(1 - λ_s) |render - target|_1 + λ_s (1 - SSIM), each the mean over pixels and channels (equation 9).

    Args:
        render: Rendered image, shape [H, W, C], H and W > 5.
        target: Ground truth in [0, 1], shape [H, W, C].
        ssim_lambda: λ_s, the share of the SSIM term, 0 to 1.

    Returns:
        The loss, a scalar.
    """
    return _image_losses([_ImageTerm("image", 1.0, render, target)], ssim_lambda)["image"]


def frame_losses(rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig) -> dict[str, Tensor]:
    """All weighted terms of one frame's loss; the total is their sum.

    A term whose weight is 0, or whose render or target is missing, is not computed and not listed.

    Args:
        rendered: What the model rendered of the frame.
        frame: The ground truth.
        config: The weights.

    Returns:
        Scalars by term, in this order: "rgb", "thermal", "features_rgb", "features_thermal", "thermal_smoothness".
    """
    losses = _image_losses(_image_terms(rendered, frame, config), config.ssim_lambda)
    if rendered.thermal is not None and config.thermal_smoothness > 0:
        losses["thermal_smoothness"] = config.thermal_smoothness * smoothness(rendered.thermal)
    return losses


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


def _image_terms(rendered: RenderedFrame, frame: "FrameTensors", config: LossConfig) -> list[_ImageTerm]:
    """The image losses that apply to this frame (equations 10 and 11)."""
    rgb = frame.rgb.image if frame.rgb is not None else None
    thermal = frame.thermal.image if frame.thermal is not None else None
    intensity = frame.thermal.intensity if frame.thermal is not None else None
    noise = config.thermal_charbonnier
    candidates: list[tuple[str, float, Tensor | None, Tensor | None, float]] = [
        ("rgb", config.rgb, rendered.rgb, rgb, 0.0),
        ("thermal", config.thermal, rendered.thermal, thermal, noise),
        ("features_rgb", config.features * config.features_rgb, _channels(rendered.visible_features, 0, 3), rgb, 0.0),
        (
            "features_thermal",
            config.features * config.features_thermal,
            _channels(rendered.thermal_features, 3, 4),
            intensity[..., None] if intensity is not None else None,
            noise,
        ),
    ]
    return [
        _ImageTerm(name, weight, render, target, epsilon)
        for name, weight, render, target, epsilon in candidates
        if weight > 0 and render is not None and target is not None
    ]


def _channels(features: Tensor | None, start: int, stop: int) -> Tensor | None:
    return None if features is None else features[..., start:stop]


def _image_losses(terms: list[_ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    """Weighted image losses by name: on CUDA by Warp's fused kernels, on the CPU by kornia's filters."""
    on_cuda = all(term.render.is_cuda for term in terms)
    compute = _fused if on_cuda else _filtered
    losses = compute([term for term in terms if term.charbonnier == 0], ssim_lambda)
    robust = [term for term in terms if term.charbonnier > 0]
    structural = compute(robust, 1.0)  # 1 - SSIM alone
    for term in robust:
        difference = charbonnier(term.render - term.target, term.charbonnier)
        losses[term.name] = (1 - ssim_lambda) * difference + ssim_lambda * structural[term.name]
    return {term.name: term.weight * losses[term.name] for term in terms}


def charbonnier(differences: Tensor, epsilon: float) -> Tensor:
    """Mean of sqrt(d² + ε²) - ε: d² / 2ε for differences well below ε, |d| - ε for those well above it.

    Args:
        differences: Any shape.
        epsilon: ε > 0, in the differences' units.
    """
    return torch.sqrt(differences.square() + epsilon**2).mean() - epsilon


def _fused(terms: list[_ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    return {term.name: warp_image_loss(term.render, term.target, ssim_lambda) for term in terms}


def _filtered(terms: list[_ImageTerm], ssim_lambda: float) -> dict[str, Tensor]:
    """Image losses by name, with one call for the channels of all images of one size.

    L1 and SSIM treat channels separately, so stacking the channels of several images changes no value; one convolution
    over ten channels takes about a third of the time of four small ones.
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
