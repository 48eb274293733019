"""Image metrics of one view, as the field reports them.

Convention: images are [H, W, C] in [0, 1]; renders are clamped to that range and otherwise kept in floating point, as
gsplat's trainer does, not rounded to the 8 bits of the ground truth. (Rounding adds an error of 1/(12·255²): PSNR falls
by 0.006 dB at 30 dB, by 0.06 dB at 40 dB.) Averages over views are means of per-view values, made by the evaluation.
"""

import math

import torch
from torch import Tensor

from thermosplat.image_quality.ssim import ssim_map


def psnr(render: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio over all pixels that count, and channels.

    Args:
        render: Rendered image, shape [H, W, C]; clamped to [0, 1] here.
        target: Ground truth in [0, 1], shape [H, W, C].
        mask: bool [H, W], which pixels count; None: all.

    Returns:
        -10 log10(mean squared error) [dB]; infinity for equal images, NaN if a pixel is NaN or none counts.
    """
    squares = (render.clamp(0, 1) - target).square()
    squared_error = (squares if mask is None else squares[mask]).mean().item()
    return math.inf if squared_error == 0 else -10.0 * math.log10(squared_error)


def ssim(render: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Mean structural similarity: 11x11 Gaussian window, σ = 1.5, borders reflected (see ``ssim_map``).

    Args:
        render: Rendered image, shape [H, W, C], H and W > 5; clamped to [0, 1] here.
        target: Ground truth in [0, 1], shape [H, W, C].
        mask: bool [H, W], which pixels count; None: all. In windows that reach beyond them, the render is right there.

    Returns:
        SSIM, at most 1; NaN if no pixel counts.
    """
    seen = right_outside(render.clamp(0, 1), target, mask)
    similarities = ssim_map(seen.permute(2, 0, 1), target.permute(2, 0, 1))
    return (similarities if mask is None else similarities[:, mask]).mean().item()


def right_outside(render: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """The render with its target in place of pixels that do not count, for metrics that look at more than a pixel.

    Args:
        render: [H, W, C].
        target: [H, W, C].
        mask: bool [H, W], which pixels count; None: all.
    """
    return render if mask is None else torch.where(mask[..., None], render, target)
