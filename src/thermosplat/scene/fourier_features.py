"""Sines and cosines of rendered features, which decoders see beside them."""

import torch
from torch import Tensor


def with_fourier_features(features: Tensor, frequency: float) -> Tensor:
    """Features f with sin(ω f) and cos(ω f) behind them.

    Networks of few layers learn slowly what varies fast with their input; waves of it make that easy (Fourier features,
    Tancik et al. 2020). Neural Harmonic Textures (arXiv 2604.01204) do the same with what Gaussians blend.

    Args:
        features: A_f, shape [..., d].
        frequency: ω [radians per unit of a feature]; 0: features stay as they are.

    Returns:
        Shape [..., 3 d], or [..., d] where the frequency is 0.
    """
    if frequency == 0:
        return features
    angles = frequency * features
    return torch.cat([features, torch.sin(angles), torch.cos(angles)], dim=-1)


def num_inputs(feature_dim: int, frequency: float) -> int:
    """Channels of ``with_fourier_features``.

    Args:
        feature_dim: Channels d of the features.
        frequency: ω.
    """
    return feature_dim if frequency == 0 else 3 * feature_dim
