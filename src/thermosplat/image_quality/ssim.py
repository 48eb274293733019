"""Structural similarity as training and evaluation use it: one window, one border rule, one data range.

``kornia.metrics.ssim`` is the definition (tests hold this file to it). It filters five maps one by one and builds its
window anew at every call; here four maps, the squares of both images in one, are filtered in two calls.
"""

import functools
from typing import Any

import cv2
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

SSIM_WINDOW = 11
"""Taps of the Gaussian window along an axis [px]. 3DGS, ThermalGaussian, MMOne."""

SSIM_SIGMA = 1.5
"""Standard deviation of the window [px]. Wang et al. 2004, 3DGS; kornia fixes it too."""

C1, C2 = 0.01**2, 0.03**2
"""Stabilising constants for a data range of 1. Wang et al. 2004."""

EPSILON = 1e-12
"""Added to the denominator, as kornia does."""


def ssim_map(render: Tensor, target: Tensor) -> Tensor:
    """Structural similarity of every pixel and channel, for a data range of 1.

    Channels are independent: stacking the channels of several images changes no value.

    Convention: borders are reflected, as in kornia and torchmetrics 1.9, with which gsplat's trainer evaluates. Its
    training loss (fused-ssim, padding="valid") and torchmetrics up to 1.0 use only windows that lie inside the image.
    The 3DGS code, ThermalGaussian and MMOne pad with zeros. All differ within 5 px of the border only: padded with
    zeros, one 64 px image has 0.9453 where this gives 0.9488; larger images differ less.

    Args:
        render: Image, channels first, shape [C, H, W], H and W > 5; not clamped.
        target: Image, shape [C, H, W].

    Returns:
        SSIM, at most 1, shape [C, H, W].
    """
    window = _window(render.device, render.dtype)
    # of the squares only the sum is needed
    maps = torch.cat([render, torch.addcmul(target * target, render, render), render * target])
    mean_x, square, product = window_filter(maps, window).chunk(3)
    mean_y = window_filter(target, window)  # apart: a target rarely wants a gradient
    means = mean_x * mean_y
    squares = mean_x * mean_x + mean_y * mean_y
    numerator = (2 * means + C1) * (2 * (product - means) + C2)
    denominator = (squares + C1) * (square - squares + C2)
    return numerator / (denominator + EPSILON)


@functools.lru_cache(maxsize=8)
def _window(device: torch.device, dtype: torch.dtype) -> Tensor:
    """The Gaussian window, shape [1, SSIM_WINDOW]."""
    import kornia  # takes 0.2 s, which a viewer's first picture need not wait for

    return kornia.filters.get_gaussian_kernel1d(SSIM_WINDOW, SSIM_SIGMA, device=device, dtype=dtype)


_IN_OPENCV = (torch.float32, torch.float64)
"""What OpenCV filters; kornia filters anything else, and whatever is on a GPU."""


def window_filter(images: Tensor, window: Tensor) -> Tensor:
    """Average the pixels around each pixel; at borders images are reflected, the outermost pixel not repeated.

    By kornia; on the CPU by OpenCV, which takes half of its time and is its own adjoint (``_WindowFilter.backward``).

    Args:
        images: Shape [C, H, W], H and W > K / 2.
        window: Weights along either axis, symmetric, shape [1, K], K odd.

    Returns:
        The averages, shape [C, H, W].
    """
    if images.device.type == "cpu" and images.dtype in _IN_OPENCV:
        averaged: Tensor = _WindowFilter.apply(images, window)
        return averaged
    import kornia  # takes 0.2 s, which a viewer's first picture need not wait for

    return kornia.filters.filter2d_separable(images[None], window, window)[0]


class _WindowFilter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: Tensor, window: Tensor) -> Tensor:
        ctx.window = window
        return _averaged(images, window)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_averaged: Tensor) -> tuple[Tensor, None]:
        # Reflected for ever, an image is periodic: in one period, the outermost pixels appear once, all others twice.
        # With these numbers as weights a symmetric filter is its own adjoint; only their ratio, a half, matters.
        v_weighted = v_averaged.clone(memory_format=torch.contiguous_format)
        _scale_borders(v_weighted, 2.0)
        v_images = _averaged(v_weighted, ctx.window)
        _scale_borders(v_images, 0.5)
        return v_images, None


def _scale_borders(images: Tensor, factor: float) -> None:
    """Multiply the outermost rows, and the outermost columns; corners twice."""
    for axis in (-2, -1):
        for outermost in (0, -1):
            images.select(axis, outermost).mul_(factor)


def _averaged(images: Tensor, window: Tensor) -> Tensor:
    averaged = torch.empty_like(images, memory_format=torch.contiguous_format)
    weights = window[0].numpy()
    for source, target in zip(images.detach().contiguous().numpy(), averaged.numpy(), strict=True):
        cv2.sepFilter2D(source, -1, weights, weights, dst=target, borderType=cv2.BORDER_REFLECT_101)
    return averaged
