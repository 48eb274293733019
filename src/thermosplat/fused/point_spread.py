"""Images as a camera blurs them, as a torch function of Warp kernels."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import kinds_of, strided_view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch
from warp_kernels.training.point_spread import point_spread_kernels


def blurred_by_gaussian(image: Tensor, sigma: Tensor, radius: int) -> Tensor:
    """An image under a Gaussian point spread, whose weights are those of the pixels' centres.

    What lies beyond the border does not count: weights are divided by the sum of those that are left.

    Args:
        image: Shape [H, W, C]. Receives a gradient.
        sigma: Standard deviation [px], > 0, scalar. Receives a gradient.
        radius: Pixels that count on each side, >= 1.
    """
    return _Blur.apply(image.contiguous(), sigma, radius)


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, sigma: Tensor, radius: int) -> Tensor:
        table = _table(sigma, radius)
        across, both = torch.empty_like(image), torch.empty_like(image)
        (along, width), (down, height) = _axes(image)
        kernel, _ = point_spread_kernels(kinds_of(image.dtype).scalar)
        with launches_on_torch_stream(image.device) as device:
            weights = strided_view(table)
            of_rows = [_numbers(image), weights, along, width, _numbers(across)]
            of_columns = [_numbers(across), weights, down, height, _numbers(both)]
            for inputs in (of_rows, of_columns):
                launch(kernel, image.numel(), inputs, device)
        ctx.save_for_backward(image, across, both, table)
        return both

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_both: Tensor) -> tuple[Tensor | None, ...]:
        image, across, both, table = ctx.saved_tensors
        v_both = v_both.contiguous()
        v_across, v_image, shares = (torch.empty_like(image) for _ in range(3))
        (along, width), (down, height) = _axes(image)
        _, kernel = point_spread_kernels(kinds_of(image.dtype).scalar)
        with launches_on_torch_stream(image.device) as device:
            weights = strided_view(table)
            given = _numbers(across), _numbers(both), weights, down, height, _numbers(v_both)
            launch(kernel, image.numel(), [*given, _numbers(v_across), _numbers(shares)], device)
        v_sigma = shares.sum()
        with launches_on_torch_stream(image.device) as device:
            given = _numbers(image), _numbers(across), weights, along, width, _numbers(v_across)
            launch(kernel, image.numel(), [*given, _numbers(v_image), _numbers(shares)], device)
        return v_image, v_sigma + shares.sum(), None


def _table(sigma: Tensor, radius: int) -> Tensor:
    """w = exp(-k² / 2σ²) and dw/dσ = w k² / σ³ of pixels 0 to R apart, each with its sums below it, [4, R + 1]."""
    squares = torch.arange(radius + 1, device=sigma.device, dtype=sigma.dtype).square()
    weights = torch.exp(-0.5 * squares / sigma.square())
    rows = torch.stack([weights, weights * squares / sigma**3])
    return torch.stack([rows, rows.cumsum(dim=1)], dim=1).reshape(4, -1)


def _axes(image: Tensor) -> tuple[tuple[int, int], tuple[int, int]]:
    """Stride and pixels along the image's width and height."""
    height, width, channels = image.shape
    return (channels, width), (width * channels, height)


def _numbers(image: Tensor) -> Any:
    return strided_view(image.view(-1))
