"""SSIM maps: shape, independence of channels, and what equal and opposite images score."""

import kornia
import torch

from thermosplat.image_quality.ssim import ssim_map


def image(channels: int, seed: int) -> torch.Tensor:
    return torch.rand(channels, 14, 20, generator=torch.Generator().manual_seed(seed))


def test_channels_are_independent() -> None:
    """Stacked images have the maps they have alone; this is what lets the losses share one call."""
    first, second = (image(3, 0), image(3, 1)), (image(1, 2), image(1, 3))
    stacked = ssim_map(torch.cat([first[0], second[0]]), torch.cat([first[1], second[1]]))
    assert stacked.shape == (4, 14, 20)
    torch.testing.assert_close(stacked[:3], ssim_map(*first))
    torch.testing.assert_close(stacked[3:], ssim_map(*second))


def test_equal_and_inverted_images() -> None:
    """Equal images score 1 everywhere, inverted ones negative on average."""
    original = image(2, 4)
    torch.testing.assert_close(ssim_map(original, original), torch.ones(2, 14, 20), atol=1e-4, rtol=0)
    assert ssim_map(original, 1 - original).mean() < -0.3


def test_equals_kornia() -> None:
    """kornia's own SSIM is the definition: value and gradient, also out of range."""
    render, target = 1.5 * image(4, 5) - 0.2, image(4, 6)
    maps, gradients = [], []
    for ssim in (lambda x: ssim_map(x, target), lambda x: kornia.metrics.ssim(x[None], target[None], 11)[0]):
        leaf = render.clone().requires_grad_()
        maps.append(ssim(leaf))
        (gradient,) = torch.autograd.grad(maps[-1].square().sum(), leaf)
        gradients.append(gradient)
    torch.testing.assert_close(maps[0], maps[1], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-4, rtol=1e-4)
