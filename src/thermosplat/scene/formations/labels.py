"""Labels: which class a pixel belongs to, as label images teach it (Feature 3DGS, Zhou et al. 2024; MMOne).

The network has a score for each class, and the image shows the best one in its colour.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.class_colors import colors_of, numbers_of
from thermosplat.config import LossConfig, ModelConfig
from thermosplat.fused.image_loss import ImageTerm
from thermosplat.scene.formations.formation import Blended, Common, LossTerm
from thermosplat.scene.formations.own_network import NetworkFormation
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum, SpectrumConfig

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors

CROSS_ENTROPY = 0.015
"""Weight of the cross-entropy [nats] beside the losses of images. Open choice: with three times as much thermal images
lose, and labels gain nothing (benchmarks/records/kinds.md)."""
_NO_CLASS = -1
_MIXED = 0.01
"""Distance from an 8-bit level from which on a colour is a mean of several [levels]."""


class LabelFormation(NetworkFormation):
    """The image has the colours of the most probable classes.

    Attributes:
        classes: Names of the classes.
    """

    def __init__(self, spectrum: Spectrum, common: Common) -> None:
        super().__init__(spectrum, common, len(spectrum.settings.classes))
        self.classes = spectrum.settings.classes

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """As of ``Formation``: its images are labels."""
        return spectrum.settings.source == "labels"

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """As of ``Formation``."""
        with torch.no_grad():
            return _shown(self.made_of(blended.features))

    def losses(
        self, rendered: RenderedFrame, view: "ViewTensors", settings: SpectrumConfig, weights: LossConfig
    ) -> list[ImageTerm | LossTerm]:
        """As of ``Formation``: the mean cross-entropy of the pixels that have a class."""
        blended = rendered.features.get(self.name)
        if settings.loss == 0 or blended is None or view.image is None:
            return []
        classes = self.classes_in(view.image)
        if view.mask is not None:
            classes = torch.where(view.mask, classes, _NO_CLASS)
        scores = self.network(blended).flatten(0, 1)
        total = F.cross_entropy(scores, classes.flatten(), ignore_index=_NO_CLASS, reduction="sum")
        mean = total / (classes != _NO_CLASS).sum().clamp(min=1)
        return [LossTerm(self.name, settings.loss * CROSS_ENTROPY * mean)]

    def pixels_of_features(self, features: Tensor, alpha: Tensor, view: "ViewTensors", every: int) -> Tensor:
        """As of ``Formation``: probabilities of the classes."""
        return super().pixels_of_features(features, alpha, view, every).softmax(dim=-1)

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """As of ``Formation``: the class of its own features."""
        return _shown(self.of_each(gaussians))

    def classes_in(self, image: Tensor) -> Tensor:
        """As of ``Formation``; colours that are mixed, as in smaller images, are of none."""
        levels = image * 255
        colors = levels.round().long()
        numbers = numbers_of(*colors.unbind(dim=-1))
        pure = (colors == torch.stack(colors_of(numbers), dim=-1)) & ((levels - colors).abs() < _MIXED)
        return torch.where(pure.all(dim=-1) & (numbers < len(self.classes)), numbers, _NO_CLASS)

    def graded(self, rendered: RenderedFrame) -> Tensor:
        """As of ``Formation``: probabilities of the classes; the best class of a pixel flips or stays."""
        return self.network(rendered.features[self.name]).softmax(dim=-1)

    def graded_truth(self, image: Tensor) -> Tensor:
        """As of ``Formation``: 1 for the class of a pixel."""
        classes = self.classes_in(image)
        return F.one_hot(classes.clamp(min=0), len(self.classes)) * (classes != _NO_CLASS)[..., None].to(image)

    def scores(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Mapping[str, float]:
        """As of ``Formation``: intersection over union of each class that either image has, and their mean."""
        counts = torch.ones_like(image[..., 0], dtype=torch.bool) if mask is None else mask
        found, true = self.classes_in(image)[counts], self.classes_in(target)[counts]
        shares = {}
        for number, name in enumerate(self.classes):
            is_found, is_true = found == number, true == number
            union = (is_found | is_true).sum().item()
            shares[f"iou_{name}"] = (is_found & is_true).sum().item() / union if union else float("nan")
        return {"miou": torch.tensor(list(shares.values())).nanmean().item(), **shares}


def _shown(scores: Tensor) -> Tensor:
    """Colours of the best classes, [..., 3], of scores [..., K]."""
    return torch.stack(colors_of(scores.argmax(dim=-1)), dim=-1) / 255.0
