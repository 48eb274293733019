"""Structural similarity as training and evaluation use it: one window, one border rule, one data range."""

import kornia
from torch import Tensor

SSIM_WINDOW = 11
"""Taps of the Gaussian window along an axis [px]; kornia fixes its σ at 1.5. 3DGS, ThermalGaussian, MMOne."""


def ssim_map(render: Tensor, target: Tensor) -> Tensor:
    """Structural similarity of every pixel and channel, for a data range of 1.

    Channels are independent: stacking the channels of several images changes no value.

    Convention: borders are reflected, as in kornia and torchmetrics (and so in gsplat's trainer). The SSIM of the 3DGS
    code, ThermalGaussian and MMOne pads with zeros instead, which differs within 5 px of the border only: 0.9453 where
    this gives 0.9488 on one 64 px image, less on larger ones.

    Args:
        render: Image, channels first, shape [C, H, W], H and W > 5; not clamped.
        target: Image, shape [C, H, W].

    Returns:
        SSIM, at most 1, shape [C, H, W].
    """
    return kornia.metrics.ssim(render[None], target[None], SSIM_WINDOW, max_val=1.0)[0]
