"""Labels: which class a pixel belongs to, as label images teach it (Feature 3DGS, Zhou et al. 2024; MMOne).

A network turns what is blended into one score for each class, and the image shows the best one in its colour. Where
Gaussians have features, they are the scene's: they learn of labels, too. Without, labels have SH colours of their own,
which stand for no colour, as MMOne's embeddings do.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from thermosplat.class_colors import colors_of, numbers_of
from thermosplat.config import LossConfig, ModelConfig
from thermosplat.fused.image_loss import ImageTerm
from thermosplat.scene.decoding_in_parts import decode_in_parts
from thermosplat.scene.formations.formation import Blended, Common, Formation
from thermosplat.scene.formations.image_terms import LossTerm
from thermosplat.scene.gaussians import SH_C0, Gaussians, PointColors, sh_names
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum, SpectrumConfig

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors

CROSS_ENTROPY = 0.05
"""Weight of the cross-entropy [nats] beside losses of images, which are about 0.05 where cross-entropies are 1. Open
choice; benchmarks/records/kinds.md."""
_NO_CLASS = -1
_MIXED = 0.01
"""Distance from an 8-bit level from which on a colour is a mean of several [levels]."""


class LabelFormation(Formation):
    """The image has the colours of the most probable classes.

    Attributes:
        classes: Names of the classes.
        network: What is blended, [..., d], -> scores of classes, [..., K].
    """

    def __init__(self, spectrum: Spectrum, common: Common) -> None:
        super().__init__(spectrum, common)
        self.classes = spectrum.settings.classes
        self.takes_features = common.model.feature_dim > 0
        self.takes_colors = not self.takes_features
        inputs, hidden = common.model.feature_dim or 3, common.decoding.hidden_dim
        self.network = nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, len(self.classes)))

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """As of ``Formation``: its images are labels."""
        return spectrum.settings.source == "labels"

    def initial(self, points: PointColors, *, is_first: bool) -> dict[str, Tensor]:
        """As of ``Formation``: SH colours where there are no features."""
        if is_first or self.takes_features:
            return {}
        return dict(zip(sh_names(self.name), points.harmonics(self.spectrum), strict=True))

    def through_optics(self, blended: Blended) -> Blended:
        """As of ``Formation``: what the network takes are features, wherever it comes from."""
        return blended if self.takes_features else dataclasses.replace(blended, features=blended.colors)

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """As of ``Formation``.

        Raises:
            ValueError: Nothing was blended that has classes.
        """
        if blended.features is None:
            raise ValueError(f"{self.name} takes features or SH colours, and none were blended.")
        return self._shown(blended.features)

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
        return self.network(features.flatten(0, 1)[::every]).softmax(dim=-1)

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """As of ``Formation``: the class of its own features."""
        if self.takes_features:
            return self._shown(gaussians.expanded(gaussians.features))
        return self._shown(0.5 + SH_C0 * gaussians.sh_coeffs_of(self.name)[0][:, 0])

    def classes_in(self, image: Tensor) -> Tensor:
        """As of ``Formation``; colours that are mixed, as in smaller images, are of none."""
        levels = image * 255
        colors = levels.round().long()
        numbers = numbers_of(*colors.unbind(dim=-1))
        pure = (colors == torch.stack(colors_of(numbers), dim=-1)) & ((levels - colors).abs() < _MIXED)
        return torch.where(pure.all(dim=-1) & (numbers < len(self.classes)), numbers, _NO_CLASS)

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

    @torch.no_grad()
    def _shown(self, features: Tensor) -> Tensor:
        """Colours of the best classes, [..., 3]."""
        parted = features.ndim == 3
        scores = decode_in_parts(self._scores, {self.name: features})[self.name] if parted else self.network(features)
        best = scores.argmax(dim=-1)
        return torch.stack(colors_of(best), dim=-1) / 255.0

    def _scores(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: self.network(values) for name, values in features.items()}
