"""deterministic=True: the same bits on every run, and the same gradients as without."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from gaussian_scenes import leaves, random_rgbt_scene, random_scene
from thermosplat import rasterization, rasterization_rgbt
from warp_kernels.blending import blending_step
from warp_kernels.blending.blend_layout import BlendLayout, default_layout


def _gradients(device: torch.device, tile_size: int, **how: Any) -> dict[str, Tensor]:
    """Of a frame whose Gaussians lie in many tiles and, on CUDA, under many warps."""
    scene = leaves(random_rgbt_scene(n=600, width=120, height=90, cameras=2, channels=3), device, torch.float32)
    render = rasterization_rgbt(**scene, tile_size=tile_size, **how)
    images = [render.render_colors, render.render_features, render.render_thermal_features, render.render_alphas]
    generator = torch.Generator().manual_seed(3)
    torch.autograd.backward(images, [torch.randn(i.shape, generator=generator).to(device) for i in images])
    return {name: value.grad for name, value in scene.items() if isinstance(value, Tensor) and value.grad is not None}


@pytest.mark.parametrize("tile_size", [8, 16])
def test_same_bits_every_time(device: torch.device, tile_size: int) -> None:
    """Five backward passes, five times the same bits."""
    first = _gradients(device, tile_size, deterministic=True)
    assert len(first) >= 8
    for _ in range(4):
        again = _gradients(device, tile_size, deterministic=True)
        for name, gradient in first.items():
            assert torch.equal(gradient, again[name]), name


@pytest.mark.parametrize("tile_size", [8, 16])
def test_same_gradients_as_without(device: torch.device, tile_size: int) -> None:
    """Only the order of the sums differs."""
    plain = _gradients(device, tile_size)
    for name, gradient in _gradients(device, tile_size, deterministic=True).items():
        assert gradient.norm() > 0
        assert (gradient - plain[name]).norm() < 1e-5 * gradient.norm(), name


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("channels", [5, 32])
def test_one_opacity(device: torch.device, channels: int, absgrad: bool) -> None:
    """The plain rasterization takes the argument too, also where its sums lie where gradients do, for two cameras."""
    scene = random_rgbt_scene(n=200, cameras=2, channels=channels)
    for name in ("features", "thermal_opacities"):
        del scene[name]
    results = []
    for deterministic in (True, True, False):
        inputs = leaves(scene, device, torch.float32)
        image, alphas, info = rasterization(**inputs, absgrad=absgrad, deterministic=deterministic)
        info["means2d"].retain_grad()
        (image.square().sum() + alphas.square().sum()).backward()
        gradients = {name: one.grad for name, one in inputs.items() if isinstance(one, Tensor) and one.requires_grad}
        results.append(gradients | {"means2d": info["means2d"].grad})
    assert {"means", "quats", "scales", "opacities", "colors", "means2d"} <= results[0].keys()
    for name, gradient in results[0].items():
        assert gradient.norm() > 0
        assert torch.equal(gradient, results[1][name]), name
        assert (gradient - results[2][name]).norm() < 1e-5 * gradient.norm(), name


@pytest.mark.parametrize("worth_a_wait", [0, 2**40])
@pytest.mark.parametrize("channels", [3, 32])
def test_long_lists_are_cut(
    device: torch.device, channels: int, worth_a_wait: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On CUDA lists of a thousand pairs are; results are those of whole lists, whatever room states have."""
    monkeypatch.setattr(blending_step, "WORTH_A_WAIT", worth_a_wait)
    dealt, results = [], []

    def layout(*frame: Any, cut: bool) -> BlendLayout:
        found = default_layout(*frame)
        dealt.append(found.segment)
        return found if cut else replace(found, segment=0)

    for cut in (True, False):
        monkeypatch.setattr(blending_step, "default_layout", partial(layout, cut=cut))
        scene = random_scene(n=4000, width=64, height=48, channels=channels, backgrounds=False)
        inputs = leaves(scene, device, torch.float32)
        image, alphas, _ = rasterization(**inputs)
        (image.square().sum() + alphas.square().sum()).backward()
        results.append({name: inputs[name].grad for name in ("means", "quats", "scales", "opacities", "colors")})
        results[-1]["image"] = image.detach()
    assert all(segment > 0 for segment in dealt) == (device.type == "cuda")
    assert (results[0]["image"] - results[1]["image"]).abs().max() < 2e-6
    for name, gradient in results[0].items():
        assert gradient.norm() > 0
        assert (gradient - results[1][name]).norm() < 1e-5 * gradient.norm(), name


def test_two_opacities_without_a_record(device: torch.device) -> None:
    """Many channels of both kinds leave nothing for a record of sums; gradients are those of stored records."""
    scene = random_rgbt_scene(n=200, cameras=2, channels=16)
    results = []
    for deterministic in (True, False):
        inputs = leaves(scene, device, torch.float32)
        render = rasterization_rgbt(**inputs, deterministic=deterministic)
        images = [render.render_colors, render.render_features, render.render_thermal_features]
        torch.autograd.backward(images, [torch.ones_like(image) for image in images])
        results.append({name: one.grad for name, one in inputs.items() if isinstance(one, Tensor)})
    assert {"opacities", "thermal_opacities", "features"} <= results[0].keys()
    for name, gradient in results[0].items():
        if gradient is not None:
            assert gradient.norm() > 0
            assert (gradient - results[1][name]).norm() < 1e-5 * gradient.norm(), name
