"""The scene gsplat's own profiling uses: its garden asset on a grid, with random shapes, opacities and colours."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor


def load_garden(
    asset: str | Path | None, grid: int, width: int, height: int, device: torch.device, seed: int = 42
) -> dict[str, Tensor]:
    """Gaussians and one camera of the garden asset, or of a synthetic stand-in where the asset is absent.

    Args:
        asset: ``test_garden.npz`` of gsplat's repository (assets/), or None for a stand-in of as many Gaussians.
        grid: the points are repeated on a grid x grid of copies; odd.
        width: image width [px]; the intrinsics are scaled to it.
        height: image height [px].
        device: where the tensors go.
        seed: of shapes, opacities and coefficients.

    Returns:
        means [N, 3], quats [N, 4], scales [N, 3] in U(0, 0.02), opacities [N] in U(0, 1), sh_coeffs [N, 16, 3],
        viewmats [1, 4, 4], Ks [1, 3, 3].
    """
    generator = torch.Generator().manual_seed(seed)
    if asset is not None:
        data = np.load(asset)
        means = torch.from_numpy(data["means3d"]).float()
        means = means[(means.abs() <= 2).all(-1)]
        viewmat, K = torch.from_numpy(data["viewmats"][0]).float(), torch.from_numpy(data["Ks"][0]).float()
        K[0] *= width / int(data["width"])
        K[1] *= height / int(data["height"])
    else:
        means = torch.rand(111_785, 3, generator=generator) * 4 - 2
        viewmat, K = torch.eye(4), torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
        viewmat[2, 3] = 5.0
    size = means.amax(0) - means.amin(0)
    steps = torch.arange(grid) - grid // 2
    offsets = torch.stack(torch.meshgrid(steps, steps, torch.tensor([0]), indexing="ij"), -1).reshape(-1, 1, 3)
    means = (means + offsets * size).reshape(-1, 3)
    n = len(means)
    scene = {
        "means": means,
        "quats": torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=-1),
        "scales": torch.rand(n, 3, generator=generator) * 0.02,
        "opacities": torch.rand(n, generator=generator),
        "sh_coeffs": torch.randn(n, 16, 3, generator=generator) * 0.3,
        "viewmats": viewmat[None],
        "Ks": K[None],
    }
    return {name: tensor.to(device).contiguous() for name, tensor in scene.items()}
