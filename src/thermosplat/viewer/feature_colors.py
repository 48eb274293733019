"""Latent features as colours: three principal components."""

from dataclasses import dataclass

import torch
from torch import Tensor

_SPREAD = 3.0
"""Standard deviations of the features' principal components from black to full colour, to either side."""


@dataclass(frozen=True)
class FeatureColors:
    """Three principal components of the Gaussians' features as red, green and blue."""

    mean: Tensor
    """[d]."""
    components: Tensor
    """Directions, each divided by the standard deviation along it, [d, 3]."""

    @classmethod
    def of(cls, features: Tensor, weights: Tensor) -> "FeatureColors":
        """The components of features [N, d], each of which counts by its weight [N]."""
        share = (weights / weights.sum().clamp(min=1e-12))[:, None]
        mean = (share * features).sum(dim=0)
        centred = features - mean
        values, vectors = torch.linalg.eigh((share * centred).T @ centred)  # rising
        chosen = vectors[:, -3:].flip(-1)
        chosen = chosen * torch.where(chosen.sum(dim=0) < 0, -1.0, 1.0)  # either sign is as good: one that stays
        scaled = chosen / values[-3:].flip(-1).clamp(min=1e-12).sqrt()
        padded = torch.zeros(features.shape[1], 3, device=features.device, dtype=features.dtype)
        padded[:, : scaled.shape[1]] = scaled
        return cls(mean, padded)

    def colors(self, blended: Tensor, alpha: Tensor) -> Tensor:
        """Colours [H, W, 3] of features [H, W, d] that were blended to opacities [H, W, 1]; black where nothing is."""
        there = blended / alpha.clamp(min=1e-3)
        return (0.5 + (there - self.mean) @ self.components / (2 * _SPREAD)).clamp(0, 1) * alpha
