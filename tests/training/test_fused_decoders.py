"""Fused kernels give the images and gradients of the decoders they stand for."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders
from thermosplat.training.fast_decoders import BRANCHES, FastDecoders

SHAPES = [(64, 8, 3), (32, 5, 1), (16, 16, 3)]
"""hidden, features, thermal channels"""

INTERPRETED = """
import torch
import triton.language as tl
from test_fused_decoders import SHAPES, all_finite, worst_difference
from thermosplat.training import fused_decoders

for operand, tolerance in ((tl.float32, 1e-5), (tl.float16, 1e-2)):
    fused_decoders.OPERAND = operand
    for shape in SHAPES:
        found = worst_difference(*shape, torch.device("cpu"))
        assert found < tolerance, (operand, shape, found)
assert all_finite(torch.device("cpu"))
"""


def worst_difference(hidden: int, dim: int, thermal_channels: int, device: torch.device) -> float:
    """Largest relative difference (norm) of an image or gradient between fused and plain decoders.

    The visible features are a slice of a render, as in training; the image is no multiple of a block of pixels.
    """
    from thermosplat.training.fused_decoders import FusedDecoders, fits

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
    """Whether images and gradients stay finite beyond the largest float16: a pixel's features, one modulated channel."""
    from thermosplat.training.fused_decoders import FusedDecoders

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


def test_in_tritons_interpreter() -> None:
    """Without a GPU: exact with float32 operands, to 10 bits of mantissa with float16 ones."""
    pytest.importorskip("triton", reason="Triton is not installed (it comes with PyTorch for CUDA)")
    folders = [str(Path(__file__).parent), *sys.path]
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(folders)}
    done = subprocess.run([sys.executable, "-c", INTERPRETED], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.cuda
@pytest.mark.parametrize("shape", SHAPES)
def test_on_cuda(shape: tuple[int, int, int]) -> None:
    """Compiled for the device."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device; torch finds none")
    assert worst_difference(*shape, torch.device("cuda")) < 1e-2
    assert all_finite(torch.device("cuda"))


@pytest.mark.cuda
def test_training_on_cuda_uses_them() -> None:
    """TF32 and compiled: the default of a training on CUDA."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device; torch finds none")
    from thermosplat.training.fused_decoders import FusedDecoders

    decoders = Decoders(DecoderConfig(), 8, 3).cuda()
    with FastDecoders(decoders, compiled=True, precision="tf32").active():
        assert all(isinstance(vars(decoders)[name].__self__, FusedDecoders) for name in BRANCHES)


@pytest.mark.parametrize(("change", "dim"), [({"modulation": False}, 8), ({"hidden_layers": 3}, 8), ({}, 17)])
def test_other_decoders_are_left_alone(change: dict, dim: int) -> None:
    """Shapes without kernels."""
    pytest.importorskip("triton", reason="Triton is not installed (it comes with PyTorch for CUDA)")
    from thermosplat.training.fused_decoders import fits

    assert not fits(Decoders(DecoderConfig(**change), dim, 3))
