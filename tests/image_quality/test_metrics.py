"""Metrics of images and of measured values against direct formulas."""

import math

import pytest
import torch

from direct_ssim import direct_ssim
from thermosplat.image_quality.metrics import psnr, ssim


def test_psnr_of_a_known_error() -> None:
    """An error of 0.1 everywhere is 20 dB, of 0.01 it is 40 dB; channels and pixels count alike."""
    target = torch.full((6, 7, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    one_channel = target.clone()
    one_channel[..., 0] += 0.1
    assert psnr(one_channel, target) == pytest.approx(20.0 + 10 * math.log10(3), abs=1e-4)


def test_psnr_of_known_noise() -> None:
    """Gaussian noise of standard deviation σ has -20 log10(σ) dB."""
    noise = 0.03 * torch.randn(200, 200, 3, generator=torch.Generator().manual_seed(0))
    target = torch.full_like(noise, 0.5)
    assert psnr(target + noise, target) == pytest.approx(-20 * math.log10(0.03), abs=0.05)


def test_psnr_clamps_the_render() -> None:
    """Values outside [0, 1] count as the nearest displayable one; equal images are infinitely good."""
    target = torch.tensor([0.0, 1.0]).expand(4, 4, 2)
    assert psnr(torch.tensor([-3.0, 7.0]).expand(4, 4, 2), target) == math.inf


def test_masked_pixels_do_not_count() -> None:
    """PSNR is that of the others alone; SSIM's windows that reach beyond them find the truth there."""
    generator = torch.Generator().manual_seed(2)
    target = torch.rand(30, 25, 3, generator=generator)
    render = (target + 0.1 * torch.randn(30, 25, 3, generator=generator)).clamp(0, 1)
    mask = torch.ones(30, 25, dtype=torch.bool)
    mask[:12] = False
    wrong = torch.where(mask[..., None], render, 0.0)
    assert psnr(wrong, target, mask) == pytest.approx(psnr(render[12:], target[12:]), abs=1e-4)
    right = torch.where(mask[..., None], render, target)
    assert ssim(wrong, target, mask) == ssim(right, target, mask) < ssim(right, target)
    assert ssim(wrong, target, torch.ones_like(mask)) == ssim(wrong, target)
    assert math.isnan(psnr(wrong, target, torch.zeros_like(mask)))


def test_psnr_of_a_broken_render() -> None:
    """A single NaN makes it NaN: it must not pass for a perfect image."""
    render = torch.full((4, 4, 3), 0.5)
    render[1, 2, 0] = math.nan
    assert math.isnan(psnr(render, torch.full((4, 4, 3), 0.5)))


def test_ssim_against_the_definition() -> None:
    """Reflected borders, as torchmetrics; the render is clamped."""
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(20, 25, 3, generator=generator)
    render = target + 0.3 * torch.randn(20, 25, 3, generator=generator)
    expected = direct_ssim(render.clamp(0, 1).double().numpy(), target.double().numpy())
    assert ssim(render, target) == pytest.approx(expected, abs=1e-5)


def test_ssim_of_equal_images() -> None:
    """Equal images score 1."""
    target = torch.rand(16, 16, 1, generator=torch.Generator().manual_seed(2))
    assert ssim(target, target) == pytest.approx(1.0, abs=1e-5)


def test_ssim_and_psnr_against_torchmetrics() -> None:
    """The numbers of torchmetrics, which gsplat's trainer and MS-Splatting report, to 1e-5."""
    functional = pytest.importorskip("torchmetrics.functional.image", reason="torchmetrics is not installed")
    generator = torch.Generator().manual_seed(3)
    for height, width, channels in ((40, 55, 3), (33, 21, 1)):
        target = torch.rand(height, width, channels, generator=generator)
        render = (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1)
        pair = render.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None]
        theirs = functional.structural_similarity_index_measure(*pair, data_range=1.0).item()
        assert ssim(render, target) == pytest.approx(theirs, abs=1e-5)
        assert psnr(render, target) == pytest.approx(
            functional.peak_signal_noise_ratio(*pair, data_range=1.0).item(), abs=1e-4
        )
