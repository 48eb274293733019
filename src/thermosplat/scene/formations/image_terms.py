"""The losses of one spectrum's image: L1 and SSIM of the image, and of the latent channels that stand for it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.fused.image_loss import ImageTerm
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import SpectrumConfig

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


@dataclass(frozen=True)
class LossTerm:
    """A loss that is worked out already."""

    name: str
    """Of the loss."""
    loss: Tensor
    """Weighted, a scalar."""


def image_terms(
    name: str,
    first: int,
    rendered: RenderedFrame,
    view: "ViewTensors",
    settings: SpectrumConfig,
    weights: LossConfig,
) -> list[ImageTerm | LossTerm]:
    """The image losses of a spectrum (equations 10 and 11 of docs/method.md): those that have a weight and an image.

    Args:
        name: The spectrum, by which its image's loss is called.
        first: The first latent channel that stands for its image.
        rendered: The render.
        view: The view with its image.
        settings: The spectrum's.
        weights: Those of all spectra.

    Returns:
        At most one of the image and one of the features, "features_<spectrum>".
    """
    terms: list[ImageTerm | LossTerm] = []
    image = rendered.images.get(name)
    if settings.loss > 0 and image is not None and view.image is not None:
        compared, truth = (image, view.image) if view.mask is None else masked(image, view.image, view.mask)
        terms.append(ImageTerm(name, settings.loss, compared, truth, 0, settings.squared))
    weight = weights.features * (settings.features or 0.0)
    # latent channels stand for an intensity, of a photograph for colours
    target = view.image if view.intensity is None else view.intensity[..., None]
    blended = rendered.features.get(name)
    if weight > 0 and blended is not None and target is not None:
        if view.mask is not None:
            blended, target = masked(blended, target, view.mask, first)
        terms.append(ImageTerm(f"features_{name}", weight, blended, target, first))
    return terms


def masked(image: Tensor, target: Tensor, mask: Tensor, first: int = 0) -> tuple[Tensor, Tensor]:
    """An image and its target for losses that shall not see some pixels.

    There the image gets no gradient, and the target is the image, which leaves no difference to any loss; a window of
    SSIM that reaches beyond a mask's edge sees the same on both sides.

    Args:
        image: [H, W, X].
        target: [H, W, C].
        mask: bool [H, W], which pixels count.
        first: The target is compared with the image's channels from this one on.
    """
    counts, held = mask[..., None], image.detach()
    seen = held[..., first : first + target.shape[-1]].clamp(0.0, 1.0)
    return torch.where(counts, image, held), torch.where(counts, target, seen)
