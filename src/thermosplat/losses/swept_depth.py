"""How far what pixels show lies from where a sweep of the training images found it."""

import torch
from torch import Tensor

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
