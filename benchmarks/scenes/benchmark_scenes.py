"""Scenes to time the rasterizer on: gsplat's garden asset on a grid, trained ones, and two made of random numbers."""

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor

from scenes.garden_scene import load_garden


@dataclass(frozen=True)
class BenchmarkScene:
    """Gaussians and one camera, float32; opacities and attributes are drawn with a fixed seed."""

    name: str
    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    thermal_opacities: Tensor  # [N]
    sh: Tensor  # [N, 16, 3]
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3], for a width and height of 1
    latents: Tensor | None = None  # [N, d], trained features

    def intrinsics(self, width: int, height: int) -> Tensor:
        """Intrinsics [3, 3] for an image size [px]."""
        return torch.diag(self.K.new_tensor([width, height, 1.0])) @ self.K

    def features(self, channels: int) -> Tensor:
        """Features [N, channels], the same for the same scene and number; trained ones are repeated or cut."""
        if self.latents is not None:
            return self.latents.repeat(1, -(-channels // self.latents.shape[1]))[:, :channels].contiguous()
        device = self.means.device
        generator = torch.Generator(device).manual_seed(channels)
        return torch.rand(len(self.means), channels, generator=generator, device=device)

    def to(self, device: torch.device) -> "BenchmarkScene":
        """The scene on a device; features drawn there are other random numbers."""
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: t.to(device) for name, t in tensors.items() if isinstance(t, Tensor)})


def garden_scene(path: Path, grid: int) -> BenchmarkScene:
    """gsplat's profiling scene: its garden points repeated grid x grid times, seen by the first camera.

    Args:
        path: gsplat's ``assets/test_garden.npz``.
        grid: odd number of repetitions in x and y.

    Returns:
        The scene, with scales U(0, 0.02), random rotations and opacities U(0, 1) as in gsplat's own profiling.
    """
    garden = load_garden(path, grid, 1, 1, torch.device("cpu"))
    return BenchmarkScene(
        f"garden x{grid * grid}",
        garden["means"],
        garden["quats"],
        garden["scales"],
        garden["opacities"],
        shifted(garden["opacities"]),
        garden["sh_coeffs"],
        garden["viewmats"][0],
        garden["Ks"][0],
    )


def synthetic_scene(count: int) -> BenchmarkScene:
    """Random Gaussians that fill a 4:3 view between depth 2 and 10, about three 16 px tiles each at 320x240.

    Args:
        count: number of Gaussians. Their size in the image shrinks with it, so that the overdraw stays.

    Returns:
        The scene, with log-normal scales.
    """
    generator = torch.Generator().manual_seed(0)
    K = torch.tensor([[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]])
    depth = 2.0 + 8.0 * torch.rand(count, 1, generator=generator)
    # a little beyond the image borders
    position = 1.05 * (torch.rand(count, 2, generator=generator) - 0.5)
    means = torch.cat([position / K.diagonal()[:2] * depth, depth], -1)
    size = 0.0065 * math.sqrt(20_000 / count) * depth
    opacities = torch.rand(count, generator=generator)
    sh = 0.1 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 0] = torch.randn(count, 3, generator=generator)
    return BenchmarkScene(
        f"synthetic {count}",
        means,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        size * torch.exp(0.5 * torch.randn(count, 3, generator=generator)),
        opacities,
        shifted(opacities),
        sh,
        torch.eye(4),
        K,
    )


def huge_scene(count: int) -> BenchmarkScene:
    """The synthetic scene, with 64 Gaussians larger than the image and 512 of a third of it among the others.

    The large ones are faint (opacities 0.02 to 0.1), as trained ones are that paint fog and sky: opaque ones would hide
    the rest of the scene and be cheap.

    Args:
        count: number of Gaussians, more than 1,000.
    """
    base = synthetic_scene(count)
    generator = torch.Generator().manual_seed(2)
    large = torch.randperm(count, generator=generator)[: 64 + 512]
    depth = base.means[large, 2:]
    # The image is 1.1 depths wide. A faint Gaussian ends about 2 standard deviations from its mean.
    share = torch.full_like(depth, 0.08)
    share[:64] = 0.6
    scales, opacities = base.scales.clone(), base.opacities.clone()
    scales[large] = share * depth * (0.8 + 0.4 * torch.rand(len(large), 3, generator=generator))
    opacities[large] = 0.02 + 0.08 * torch.rand(len(large), generator=generator)
    return replace(base, name=f"huge {count}", scales=scales, opacities=opacities, thermal_opacities=shifted(opacities))


def shifted(opacities: Tensor) -> Tensor:
    """Thermal opacities: the opacities with random offsets of their logits."""
    offsets = torch.randn(len(opacities), generator=torch.Generator().manual_seed(1))
    return torch.sigmoid(torch.logit(opacities, eps=1e-6) + offsets)
