"""Images averaged under a symmetric window, borders reflected: by kornia, or on the CPU by OpenCV, which is quicker.

kornia pads and convolves along one axis and then the other, and autograd goes the same way back. OpenCV's filter takes
half of that time on one core where kornia has two, and is its own adjoint (``_WindowFilter.backward``).
"""

from typing import Any

import cv2
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_IN_OPENCV = (torch.float32, torch.float64)
"""What OpenCV filters; kornia filters anything else, and whatever is on a GPU."""


def window_filter(images: Tensor, window: Tensor) -> Tensor:
    """Average the pixels around each pixel; at borders images are reflected, the outermost pixel not repeated.

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
