"""Fused kernels give the images and gradients of the decoders they stand for."""

import pytest
import torch

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders
from thermosplat.training.fast_decoders import BRANCHES, FastDecoders
from thermosplat.warp_decoders import FusedDecoders, fits

SHAPES = [(64, 8, 3), (32, 5, 1), (64, 15, 8)]
"""hidden, features, thermal channels"""

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device; torch finds none")


def worst_difference(hidden: int, dim: int, thermal_channels: int, device: torch.device) -> float:
    """Largest relative difference (norm) of an image or gradient between fused and plain decoders.

    The visible features are a slice of a render, as in training; the image is no multiple of a block of pixels.
    """
    generator = torch.Generator().manual_seed(0)
    decoders = Decoders(DecoderConfig(hidden_dim=hidden), dim, thermal_channels)
    for parameter in decoders.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    decoders = decoders.to(device)
    assert fits(decoders)
    render = torch.randn(17, 13, 3 + dim, generator=generator).to(device).requires_grad_()
    thermal = torch.randn(17, 13, dim, generator=generator).to(device).requires_grad_()
    # as small as gradients of a mean over many pixels are
    upstream = [1e-7 * torch.randn(17, 13, c, generator=generator).to(device) for c in (3, thermal_channels)]
    results = []
    for branches in (decoders, FusedDecoders(decoders)):
        images = branches.both(render[..., 3:], thermal)
        gradients = torch.autograd.grad(images, [render, thermal, *decoders.parameters()], upstream)
        results.append([*images, *gradients])
    plain, fused = results
    return max(float((a - b).norm() / a.norm()) for a, b in zip(plain, fused, strict=True))


def all_finite(device: torch.device) -> bool:
    """Whether all stays finite where features of a pixel, or one modulated channel, exceed the largest float16."""
    generator = torch.Generator().manual_seed(0)
    finite = True
    for feature_size, modulation in ((1e6, 1.0), (1e9, 1.0), (1.0, 1e6)):
        decoders = Decoders(DecoderConfig(), 8, 3).to(device)
        with torch.no_grad():
            decoders.modulation.bias[0] = modulation
        features = torch.randn(2, 9, 9, 8, generator=generator)
        features[:, 4, 4] = feature_size
        leaf = features.to(device).requires_grad_()
        images = FusedDecoders(decoders).both(leaf[0], leaf[1])
        gradients = torch.autograd.grad(sum(image.sum() for image in images), [leaf, *decoders.parameters()])
        finite &= all(bool(torch.isfinite(tensor).all()) for tensor in (*images, *gradients))
    return finite


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("shape", SHAPES)
def test_on_cuda(shape: tuple[int, int, int]) -> None:
    """Compiled for the device."""
    assert worst_difference(*shape, torch.device("cuda")) < 1e-2
    assert all_finite(torch.device("cuda"))


@pytest.mark.cuda
@needs_cuda
def test_training_on_cuda_uses_them() -> None:
    """TF32 and compiled: the default of a training on CUDA."""
    decoders = Decoders(DecoderConfig(), 8, 3).cuda()
    with FastDecoders(decoders, compiled=True, precision="tf32").active():
        assert all(isinstance(vars(decoders)[name].__self__, FusedDecoders) for name in BRANCHES)


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize(("change", "dim"), [({"modulation": False}, 8), ({"hidden_layers": 3}, 8), ({}, 16)])
def test_other_decoders_are_left_alone(change: dict, dim: int) -> None:
    """Shapes without kernels."""
    assert not fits(Decoders(DecoderConfig(**change), dim, 3).cuda())


def test_there_are_none_on_the_cpu() -> None:
    """They are made of CUDA's matrix products."""
    assert not fits(Decoders(DecoderConfig(), 8, 3))
