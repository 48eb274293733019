"""Fused kernels give the images and gradients of the decoders they stand for."""

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp

from thermosplat.config import DecoderConfig
from thermosplat.fused import decoders as fused_decoders
from thermosplat.fused.decoders import teams_within
from thermosplat.scene.decoder import Decoders
from thermosplat.spectra import Spectrum
from thermosplat.training.fast_decoders import FastDecoders
from thermosplat.training.fused_decoders import FusedDecoders, teams
from warp_kernels.decoding.decoder_memory import TEAMS, padded_inputs

SHAPES = [(64, 8, 3), (32, 5, 1), (64, 15, 8), (64, 24, 3), (32, 24, 3), (64, 31, 8)]
"""hidden, features, thermal channels"""


def decoders_of(hidden: int = 64, dim: int = 8, thermal_channels: int = 3, **changes: Any) -> Decoders:
    """Decoders of RGB and thermal."""
    space = "scalar" if thermal_channels == 1 else "color"
    spectra = [
        Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal"),
        Spectrum("thermal", thermal_channels, space, "offset", (3, 4), None),
    ]
    return Decoders(DecoderConfig(hidden_dim=hidden, **changes), dim, spectra)


def worst_difference(hidden: int, dim: int, thermal_channels: int, team: int, device: torch.device) -> float:
    """Largest relative difference (norm) of an image or gradient between fused decoders and plain ones in float64.

    The visible features are a slice of a render, as in training; the image is no multiple of a block of pixels. The
    first layer's outputs are as large for many features as for few: float16 loses more of larger ones.
    """
    generator = torch.Generator().manual_seed(0)
    decoders = decoders_of(hidden, dim, thermal_channels)
    for parameter in decoders.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    decoders.shared_encoder[0].weight.data *= (8 / dim) ** 0.5
    decoders = decoders.to(device)
    assert team in teams(decoders)
    render = torch.randn(17, 13, 3 + dim, generator=generator).to(device).requires_grad_()
    thermal = torch.randn(17, 13, dim, generator=generator).to(device).requires_grad_()
    # as small as gradients of a mean over many pixels are
    upstream = [1e-7 * torch.randn(17, 13, c, generator=generator).to(device) for c in (3, thermal_channels)]
    fused = images_and_gradients(FusedDecoders(decoders, team), [render, thermal], upstream)
    exact = copy.deepcopy(decoders).double()
    leaves = [tensor.detach().double().requires_grad_() for tensor in (render, thermal)]
    plain = images_and_gradients(exact, leaves, [v.double() for v in upstream])
    return max(float((a - b).norm() / a.norm()) for a, b in zip(plain, fused, strict=True))


def images_and_gradients(
    branches: Decoders | FusedDecoders, leaves: list[torch.Tensor], upstream: list[torch.Tensor]
) -> list[torch.Tensor]:
    """Both images, and the gradients of a render with features behind three channels, thermal ones, and parameters."""
    render, thermal = leaves
    parameters = (branches.decoders if isinstance(branches, FusedDecoders) else branches).parameters()
    images = list(branches.decode({"rgb": render[..., 3:], "thermal": thermal}).values())
    return [*images, *torch.autograd.grad(images, [render, thermal, *parameters], upstream)]


def all_finite(team: int, device: torch.device) -> bool:
    """Whether all stays finite where features of a pixel, or one modulated channel, exceed the largest float16."""
    generator = torch.Generator().manual_seed(0)
    finite = True
    for feature_size, modulation in ((1e6, 1.0), (1e9, 1.0), (1.0, 1e6)):
        decoders = decoders_of().to(device)
        with torch.no_grad():
            decoders.modulations["rgb"].bias[0] = modulation
        features = torch.randn(2, 9, 9, 8, generator=generator)
        features[:, 4, 4] = feature_size
        leaf = features.to(device).requires_grad_()
        images = FusedDecoders(decoders, team).decode({"rgb": leaf[0], "thermal": leaf[1]}).values()
        gradients = torch.autograd.grad(sum(image.sum() for image in images), [leaf, *decoders.parameters()])
        finite &= all(bool(torch.isfinite(tensor).all()) for tensor in (*images, *gradients))
    return finite


@pytest.mark.cuda
@pytest.mark.parametrize("team", TEAMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_images_and_gradients_on_cuda(shape: tuple[int, int, int], team: int) -> None:
    """Images and gradients are right with a warp or two for 16 pixels, on a device that has room for both."""
    if team not in teams_within(shape[0], padded_inputs(shape[1]), wp.get_device("cuda").max_shared_memory_per_block):
        pytest.skip("the device allows a block too little shared memory")
    assert worst_difference(*shape, team, torch.device("cuda")) < 1e-2
    assert all_finite(team, torch.device("cuda"))


@pytest.mark.cuda
def test_gradients_of_many_pixels() -> None:
    """Blocks that decode more than once sum the same gradients with either deal of pixels to warps."""
    decoders = decoders_of().cuda()
    torch.nn.init.normal_(decoders.modulations["rgb"].weight, std=0.3)
    if set(teams(decoders)) != set(TEAMS):
        pytest.skip("the device allows a block too little shared memory")
    size = 128 * torch.cuda.get_device_properties(0).multi_processor_count * 3 + 5
    leaves = [torch.randn(1, size, c, device="cuda").requires_grad_() for c in (11, 8)]
    upstream = [torch.randn(1, size, 3, device="cuda") for _ in range(2)]
    alone, shared = (images_and_gradients(FusedDecoders(decoders, team), leaves, upstream) for team in TEAMS)
    assert all((a - b).norm() < 1e-2 * a.norm() for a, b in zip(alone, shared, strict=True))


@pytest.mark.cuda
def test_training_on_cuda_uses_them() -> None:
    """TF32 and compiled: the default of a training on CUDA."""
    decoders = decoders_of().cuda()
    assert isinstance(FastDecoders(decoders, compiled=True, precision="tf32").decode.__self__, FusedDecoders)


@pytest.mark.cuda
@pytest.mark.parametrize(("change", "dim"), [({"modulation": False}, 8), ({}, 32)])
def test_other_decoders_are_left_alone(change: dict, dim: int) -> None:
    """Shapes without kernels."""
    assert not teams(decoders_of(dim=dim, **change).cuda())


def test_there_are_none_on_the_cpu() -> None:
    """They are made of CUDA's matrix products."""
    assert not teams(decoders_of())


@pytest.mark.parametrize(
    ("shared_memory", "hidden", "inputs", "fitting"),
    [
        *((64, 64, 16, ()), (99, 64, 16, (2,)), (163, 64, 16, (1, 2)), (227, 64, 16, (1, 2))),
        *((64, 32, 16, (2,)), (99, 32, 16, (1, 2))),
        *((99, 64, 32, (2,)), (163, 64, 32, (1, 2)), (64, 32, 32, (2,)), (99, 32, 32, (1, 2))),
    ],
)
def test_warps_share_pixels_where_memory_is_short(
    shared_memory: int, hidden: int, inputs: int, fitting: tuple[int, ...]
) -> None:
    """KiB of shared memory a block: compute capability 7.5, then 8.6, 8.9 and 12.0, then 8.0, then 9.0."""
    assert teams_within(hidden, inputs, shared_memory * 1024) == fitting


@pytest.mark.parametrize(("compiled_for", "fitting"), [(75, ()), (80, (2,)), (89, (2,))])
def test_there_are_none_where_warp_compiles_for_older_gpus(
    compiled_for: int, fitting: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A consumer GPU beside one of compute capability 7.5 gets code for that, which has no such matrix products."""
    device = SimpleNamespace(max_shared_memory_per_block=99 * 1024, get_cuda_compile_arch=lambda: compiled_for)
    monkeypatch.setattr(fused_decoders, "warp_device_of", lambda _: device)
    assert fused_decoders.teams(torch.device("cuda"), 64, 8) == fitting


@pytest.mark.parametrize(("features", "fitting"), [(15, (1, 2)), (31, (1, 2)), (32, ())])
def test_there_are_none_for_features_beyond_the_widest(
    features: int, fitting: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU with room for all, up to 31 channels and a 1 behind them."""
    device = SimpleNamespace(max_shared_memory_per_block=227 * 1024, get_cuda_compile_arch=lambda: 90)
    monkeypatch.setattr(fused_decoders, "warp_device_of", lambda _: device)
    assert fused_decoders.teams(torch.device("cuda"), 64, features) == fitting


@pytest.mark.cuda
def test_a_third_spectrum_beside_the_fused_branches() -> None:
    """The two branches are fused, the third image is decoded as before; gradients of shared layers are all there."""
    torch.manual_seed(0)
    spectra = [
        Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal"),
        Spectrum("thermal", 3, "color", "offset", (3, 4), None),
        Spectrum("nir", 1, "scalar", "shared", (4, 5), None),
    ]
    decoders = Decoders(DecoderConfig(), 8, spectra).cuda()
    features = {name: torch.randn(9, 17, 8, device="cuda") for name in ("rgb", "thermal", "nir")}
    results = []
    for branches in (FusedDecoders(decoders), decoders):
        images = branches.decode(features)
        assert list(images) == list(features)
        gradients = torch.autograd.grad(sum(image.sum() for image in images.values()), list(decoders.parameters()))
        results.append([*images.values(), *gradients])
    assert all((a - b).norm() < 1e-2 * b.norm() + 1e-3 for a, b in zip(*results, strict=True))
