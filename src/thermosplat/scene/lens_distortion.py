"""Lens distortion of a rendered image: a pinhole render, resampled as the lens bends it.

Captures are undistorted when they are read. What that leaves, where a lens was calibrated badly, is small: the two
radial coefficients of COLMAP's RADIAL model, in normalised coordinates x, y of the pinhole camera,

    distorted = undistorted (1 + k1 r² + k2 r⁴),   r² = x² + y² of the undistorted point.

A pixel of the distorted image shows the pinhole render at its undistorted point, which fixed-point iteration finds. The
resampling is Catmull and Rom's cubic (1974): unlike the cubic of torch's grid_sample it moves no edge. It is
differentiable in the image, K, k1 and k2.
"""

import torch
from torch import Tensor

ITERATIONS = 5
"""Of the fixed point. Each multiplies the error by about 2 |k1| r², a few hundredths for what undistorting leaves."""


def distorted(image: Tensor, K: Tensor, coefficients: Tensor) -> Tensor:
    """A pinhole image as a lens with radial distortion shows it; outside it its border goes on.

    Args:
        image: Shape [H, W, C].
        K: Intrinsics [px], shape [3, 3].
        coefficients: k1 and k2, shape [2].

    Returns:
        Shape [H, W, C].
    """
    height, width, channels = image.shape
    x, y = (undistorted_positions(height, width, K, coefficients) - 0.5).unbind(dim=-1)
    left, top = x.detach().floor(), y.detach().floor()
    across, down = _weights(x - left), _weights(y - top)
    pixels = image.reshape(-1, channels)
    total = torch.zeros_like(image)
    for row in range(4):
        line = width * (top.long() + row - 1).clamp(0, height - 1)
        for column in range(4):
            seen = pixels[line + (left.long() + column - 1).clamp(0, width - 1)]
            total = total + (down[row] * across[column])[..., None] * seen
    return total


def nearest_distorted(image: Tensor, K: Tensor, coefficients: Tensor) -> Tensor:
    """As ``distorted``, but every pixel has the value of one pixel of the pinhole image: for depths.

    Args:
        image: Shape [H, W].
        K: Intrinsics [px], shape [3, 3].
        coefficients: k1 and k2, shape [2].

    Returns:
        Shape [H, W].
    """
    height, width = image.shape
    x, y = undistorted_positions(height, width, K, coefficients).floor().long().unbind(dim=-1)
    return image[y.clamp(0, height - 1), x.clamp(0, width - 1)]


def _weights(t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Catmull-Rom weights of the pixels at -1, 0, 1 and 2, for the position t in [0, 1)."""
    return (
        0.5 * t * (-1.0 + t * (2.0 - t)),
        1.0 + 0.5 * t * t * (3.0 * t - 5.0),
        0.5 * t * (1.0 + t * (4.0 - 3.0 * t)),
        0.5 * t * t * (t - 1.0),
    )


def undistorted_positions(height: int, width: int, K: Tensor, coefficients: Tensor) -> Tensor:
    """Where in the pinhole image each pixel of the distorted image lies.

    Args:
        height: Image height [px].
        width: Image width [px].
        K: Intrinsics [px], shape [3, 3].
        coefficients: k1 and k2, shape [2].

    Returns:
        x and y [px], pixel centres at half-integers, shape [H, W, 2].
    """
    focals, center = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    columns = torch.arange(width, dtype=K.dtype, device=K.device) + 0.5
    rows = torch.arange(height, dtype=K.dtype, device=K.device) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    seen = (torch.stack([x, y], dim=-1) - center) / focals
    point = seen
    for _ in range(ITERATIONS):
        squared = point.square().sum(dim=-1, keepdim=True)
        point = seen / (1.0 + coefficients[0] * squared + coefficients[1] * squared.square())
    return point * focals + center


def distorted_positions(positions: Tensor, K: Tensor, coefficients: Tensor) -> Tensor:
    """Where in the distorted image points of the pinhole image lie.

    Args:
        positions: x and y [px], shape [..., 2].
        K: Intrinsics [px], shape [3, 3].
        coefficients: k1 and k2, shape [2].

    Returns:
        x and y [px], shape [..., 2].
    """
    focals, center = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    point = (positions - center) / focals
    squared = point.square().sum(dim=-1, keepdim=True)
    return point * (1.0 + coefficients[0] * squared + coefficients[1] * squared.square()) * focals + center
