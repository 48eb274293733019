"""Warp's products of small matrices are torch's, and so is their gradient."""

import pytest
import torch

from thermosplat.fused.small_products import warp_small_products


@pytest.mark.parametrize("shape", [(1, 1), (400, 16), (37, 25), (0, 4)])
def test_same_as_torch(device: torch.device, shape: tuple[int, int]) -> None:
    """Values and gradients in float64, also of columns that are a slice of wider ones."""
    generator = torch.Generator().manual_seed(shape[0])
    number, rows = shape
    matrices = torch.randn(number, rows, rows, generator=generator, dtype=torch.float64).to(device)
    wide = torch.randn(number, rows, 5, generator=generator, dtype=torch.float64).to(device).requires_grad_()
    upstream = torch.randn(number, rows, 3, generator=generator, dtype=torch.float64).to(device)
    expected, found = matrices @ wide[..., 1:4], warp_small_products(matrices, wide[..., 1:4])
    torch.testing.assert_close(found, expected)
    slopes, truth = (torch.autograd.grad(value, wide, upstream) for value in (found, expected))
    torch.testing.assert_close(slopes, truth)
