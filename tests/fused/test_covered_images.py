"""Warp's covering is base + α · decoded, forward and adjoint."""

import pytest
import torch

from thermosplat.fused.covered_images import warp_covered


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("with_base", [False, True])
def test_same_as_torch(device: torch.device, channels: int, with_base: bool) -> None:
    """Values and gradients in float64, also where the base is a slice of a wider render."""
    generator = torch.Generator().manual_seed(channels)

    def image(width: int) -> torch.Tensor:
        return torch.randn(7, 9, width, generator=generator, dtype=torch.float64).to(device).requires_grad_()

    decoded, alpha, render, upstream = image(channels), image(1), image(channels + 4), image(channels).detach()
    base = render[..., :channels] if with_base else None
    expected = alpha * decoded if base is None else base + alpha * decoded
    found = warp_covered(decoded, alpha, base)
    torch.testing.assert_close(found, expected)
    leaves = [decoded, alpha, render] if with_base else [decoded, alpha]
    slopes, truth = (torch.autograd.grad(value, leaves, upstream) for value in (found, expected))
    for ours, theirs in zip(slopes, truth, strict=True):
        torch.testing.assert_close(ours, theirs)
