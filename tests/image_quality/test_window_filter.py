"""The two ways to average under a window are one function: values, gradients, borders, sizes."""

import kornia
import pytest
import torch

from thermosplat.image_quality.ssim import window_filter

WINDOW = kornia.filters.get_gaussian_kernel1d(11, 1.5, dtype=torch.float64)


def images(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("size", [(6, 6), (6, 31), (7, 8), (40, 11), (33, 64)])
@pytest.mark.parametrize("channels", [1, 5])
def test_equals_kornia(channels: int, size: tuple[int, int]) -> None:
    """On the CPU OpenCV filters, to the last digits as kornia does, and so do the gradients, corners included."""
    given, v_averaged = images(channels, *size), images(channels, *size, seed=1)
    found, expected = [], []
    for results, average in (
        (found, lambda x: window_filter(x, WINDOW)),
        (expected, lambda x: kornia.filters.filter2d_separable(x[None], WINDOW, WINDOW)[0]),
    ):
        leaf = given.clone().requires_grad_()
        averaged = average(leaf)
        results += [averaged, *torch.autograd.grad(averaged, leaf, v_averaged)]
    torch.testing.assert_close(found, expected, atol=1e-13, rtol=1e-12)


def test_strides_do_not_matter() -> None:
    """Images and gradients come as they are: cut out, transposed, expanded; none is written to."""
    whole = images(3, 20, 30)
    for given in (whole[:, 2:15, 3:20], whole.transpose(1, 2), whole[:1].expand(3, 20, 30)):
        before = given.clone()
        leaf = given.requires_grad_()
        averaged = window_filter(leaf, WINDOW)
        torch.testing.assert_close(averaged, window_filter(before, WINDOW), atol=0, rtol=0)
        v_averaged = torch.ones(1, dtype=torch.float64).expand_as(averaged)
        (gradient,) = torch.autograd.grad(averaged, leaf, v_averaged)
        torch.testing.assert_close(gradient.sum(), v_averaged.sum())
        assert torch.equal(v_averaged, torch.ones_like(averaged))
        assert torch.equal(given, before)


def test_float32_rounds_and_other_types_go_through_kornia() -> None:
    """float32 to its rounding; what OpenCV has no numbers for goes through kornia."""
    given = images(2, 12, 14)
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.bfloat16, 3e-2)):
        averaged = window_filter(given.to(dtype), WINDOW.to(dtype))
        assert averaged.dtype == dtype
        torch.testing.assert_close(averaged.double(), window_filter(given, WINDOW), atol=tolerance, rtol=tolerance)


@pytest.mark.cuda
def test_equals_cuda() -> None:
    """On a GPU kornia filters."""
    given = images(3, 20, 30)
    on_gpu = window_filter(given.cuda(), WINDOW.cuda())
    torch.testing.assert_close(on_gpu.cpu(), window_filter(given, WINDOW), atol=1e-13, rtol=1e-12)
