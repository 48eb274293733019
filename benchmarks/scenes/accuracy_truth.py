"""Float64 truth for one scene, and how far another renderer's images and gradients are from it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import reference_rasterizer
from gaussian_scenes import Scene, gradients, leaves, relative_error, upstream_gradients
from hard_scenes import LARGE, ON_THRESHOLDS, hard_scene
from thermosplat import rasterization

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]

NOT_COMPARED = ("backgrounds", "Ks")
"""Gradients left out: backgrounds' is the transmittance alone, Ks' gsplat does not have."""


@dataclass(frozen=True)
class Truth:
    """A scene rendered in float64.

    Attributes:
        scene: the arguments, float64, with the values float32 is given.
        images: colours [1, H, W, 3] and alphas [1, H, W, 1].
        certain: [1, H, W], pixels in which no threshold is so near that rounding decides what is drawn.
        upstream: gradients of the loss to the images, random, zero at the other pixels.
        gradients: by argument.
    """

    scene: Scene
    images: list[Tensor]
    certain: Tensor
    upstream: list[Tensor]
    gradients: dict[str, Tensor]


def truth_of(name: str, device: torch.device) -> Truth:
    """Renders a scene of the catalogue with the dense reference, or if it is too large with the float64 kernels."""
    scene = hard_scene(name)
    where = device if name in LARGE else "cpu"
    render: Rasterization = rasterization if name in LARGE else reference_rasterizer.rasterization
    inputs = leaves(scene, where, torch.float64)
    image, alphas, info = render(**inputs)
    if name in LARGE:
        certain = _certain(scene, device)
    elif name in ON_THRESHOLDS:
        certain = torch.ones(alphas.shape[:-1], dtype=torch.bool)
    else:
        certain = ~info["uncertain"]
    upstream = upstream_gradients([image, alphas], certain)
    found = gradients([image, alphas], upstream, inputs)
    return Truth(scene, [image.detach().cpu(), alphas.detach().cpu()], certain, upstream, _compared(found))


def _certain(scene: Scene, device: torch.device) -> Tensor:
    """Pixels in which slightly weaker and stronger opacities do not make a Gaussian appear."""
    alphas = []
    with torch.no_grad():
        for factor in (1 - 2e-3, 1 + 2e-3):
            changed = scene | {"opacities": (scene["opacities"] * factor).clamp(max=1.0)}
            alphas.append(rasterization(**leaves(changed, device, torch.float64))[1].cpu())
    # A Gaussian appears with alpha 1/255, times the transmittance.
    return (alphas[1] - alphas[0]).abs()[..., 0] < 0.5 / 255


def _compared(found: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key: gradient for key, gradient in found.items() if key not in NOT_COMPARED}


def errors(render: Rasterization, truth: Truth, device: torch.device, dtype: torch.dtype) -> dict[str, float]:
    """Renders the scene in a precision and compares.

    Returns:
        ``image``: largest absolute error of colours and alphas at the certain pixels; ``image_everywhere``: at all;
        and for each argument the relative error of its gradient in the Euclidean norm (absolute where the truth is
        zero). NaN or infinity where something is not finite.
    """
    inputs = leaves(truth.scene, device, dtype)
    images = list(render(**inputs)[:2])
    found = _compared(gradients(images, truth.upstream, inputs))
    offs = [(image.detach().double().cpu() - true).abs().amax(-1) for image, true in zip(images, truth.images)]
    off = torch.maximum(*offs)
    result = {"image": float(off[truth.certain].max()) if truth.certain.any() else 0.0}
    result["image_everywhere"] = float(off.max())
    return result | {key: relative_error(found[key], true) for key, true in truth.gradients.items()}
