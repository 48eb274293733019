"""Warp's point spread is a normalised Gaussian over the pixels that exist, forward and adjoint."""

import pytest
import torch

from thermosplat.fused.point_spread import blurred_by_gaussian


def expected(image: torch.Tensor, sigma: torch.Tensor, radius: int) -> torch.Tensor:
    """The same by dense matrices."""
    for axis in (0, 1):
        places = torch.arange(image.shape[axis], dtype=image.dtype, device=image.device)
        apart = (places[:, None] - places[None]).abs()
        weights = torch.where(apart <= radius, torch.exp(-0.5 * (apart / sigma) ** 2), 0.0)
        weights = weights / weights.sum(dim=1, keepdim=True)
        image = torch.tensordot(weights, image.movedim(axis, 0), dims=1).movedim(0, axis)
    return image


@pytest.mark.parametrize("sigma", [0.05, 0.8, 3.0, 50.0])
@pytest.mark.parametrize(("height", "width", "channels", "radius"), [(7, 12, 8, 3), (3, 40, 1, 9), (1, 1, 2, 4)])
def test_same_as_torch(device: torch.device, sigma: float, height: int, width: int, channels: int, radius: int) -> None:
    """Values and gradients in float64: narrow, wide, and images that are smaller than the kernel."""
    generator = torch.Generator().manual_seed(radius)
    image, upstream = torch.randn(2, height, width, channels, generator=generator, dtype=torch.float64).to(device)
    leaves = [image.requires_grad_(), torch.tensor(sigma, dtype=torch.float64, device=device, requires_grad=True)]
    found, truth = blurred_by_gaussian(*leaves, radius), expected(*leaves, radius)
    torch.testing.assert_close(found, truth)
    slopes, true_slopes = (torch.autograd.grad(value, leaves, upstream) for value in (found, truth))
    for ours, theirs in zip(slopes, true_slopes, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_even_images_stay_even(device: torch.device) -> None:
    """Also at the border, and the deviation does not matter there."""
    image, sigma = torch.full((9, 5, 2), 0.7, device=device), torch.tensor(2.0, device=device, requires_grad=True)
    found = blurred_by_gaussian(image, sigma, 6)
    torch.testing.assert_close(found, image)
    (slope,) = torch.autograd.grad(found.sum(), sigma)
    assert abs(slope.item()) < 1e-4


def test_strided_image(device: torch.device) -> None:
    """A slice of a wider render is read as it lies."""
    wide = torch.rand(6, 8, 5, device=device)
    sigma = torch.tensor(1.0, device=device)
    torch.testing.assert_close(
        blurred_by_gaussian(wide[..., 1:4], sigma, 3), blurred_by_gaussian(wide, sigma, 3)[..., 1:4]
    )
