"""Scenes to time the rasterizer on: gsplat's garden asset repeated on a grid, and one made of random numbers."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

GARDEN_SIZE = (648, 420)
"""Image size [px] the garden asset's intrinsics are for."""


@dataclass(frozen=True)
class BenchmarkScene:
    """Gaussians and one camera, float32 on the CPU; opacities and attributes are drawn with a fixed seed."""

    name: str
    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    thermal_opacities: Tensor  # [N]
    sh: Tensor  # [N, 16, 3]
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3], for a width and height of 1

    def intrinsics(self, width: int, height: int) -> Tensor:
        """Intrinsics [3, 3] for an image size [px]."""
        return torch.diag(torch.tensor([width, height, 1.0])) @ self.K

    def features(self, channels: int) -> Tensor:
        """Features [N, channels], the same for the same scene and number."""
        return torch.rand(len(self.means), channels, generator=torch.Generator().manual_seed(channels))


def garden_scene(path: Path, grid: int) -> BenchmarkScene:
    """gsplat's profiling scene: points cropped to [-2, 2]³ and repeated grid x grid times, seen by the first camera.

    Args:
        path: gsplat's ``assets/test_garden.npz``.
        grid: odd number of repetitions in x and y.

    Returns:
        The scene, with scales U(0, 0.02), random rotations and opacities U(0, 1) as in gsplat's own profiling.
    """
    with np.load(path) as data:
        points, colors = data["means3d"], data["colors"] / 255.0
        viewmat, K = data["viewmats"][0], data["Ks"][0]
    kept = ((points >= -2) & (points <= 2)).all(-1)
    points, colors = points[kept], colors[kept]
    steps = 4.0 * (np.arange(grid) - grid // 2)
    offsets = np.stack([*np.meshgrid(steps, steps, indexing="ij"), np.zeros((grid, grid))], -1).reshape(-1, 1, 3)
    means = torch.from_numpy((points[None] + offsets).reshape(-1, 3)).float()
    base = torch.from_numpy(np.tile(colors, (grid * grid, 1))).float()
    scales = 0.02 * torch.rand(len(means), 3, generator=torch.Generator().manual_seed(1))
    scale = np.diag([1 / GARDEN_SIZE[0], 1 / GARDEN_SIZE[1], 1.0])
    return _with_attributes(
        f"garden x{grid * grid}", means, scales, base, torch.from_numpy(viewmat).float(), torch.from_numpy(scale @ K)
    )


def synthetic_scene(count: int) -> BenchmarkScene:
    """Random Gaussians that fill a 4:3 view between depth 2 and 10, about three 16 px tiles each at 320x240.

    Args:
        count: number of Gaussians. Their size in the image shrinks with it, so that the overdraw stays.

    Returns:
        The scene, with log-normal scales.
    """
    generator = torch.Generator().manual_seed(0)
    depth = 2.0 + 8.0 * torch.rand(count, generator=generator)
    across = 2.1 * (torch.rand(count, 2, generator=generator) - 0.5)
    focal = torch.tensor([0.9, 1.2])  # in image widths and heights
    means = torch.cat([across / (2 * focal) * 2 * depth[:, None] / 2, depth[:, None]], -1)
    size = 0.0065 * math.sqrt(20_000 / max(count, 1)) * depth[:, None]
    scales = size * torch.exp(0.5 * torch.randn(count, 3, generator=generator))
    K = torch.tensor([[focal[0], 0, 0.5], [0, focal[1], 0.5], [0, 0, 1]])
    base = torch.rand(count, 3, generator=generator)
    return _with_attributes(f"synthetic {count}", means, scales, base, torch.eye(4), K)


def _with_attributes(
    name: str, means: Tensor, scales: Tensor, base: Tensor, viewmat: Tensor, K: Tensor
) -> BenchmarkScene:
    generator = torch.Generator().manual_seed(42)
    count = len(means)
    sh = 0.1 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 0] = (base - 0.5) / 0.28209479177387814
    opacities = torch.rand(count, generator=generator)
    shift = torch.randn(count, generator=generator)
    return BenchmarkScene(
        name,
        means,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        scales,
        opacities,
        torch.sigmoid(torch.logit(opacities, eps=1e-6) + shift),
        sh,
        viewmat,
        K.float(),
    )
