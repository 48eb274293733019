"""How far Gaussians are from a camera's centre: gsplat's order and depth with ``global_z_order=False``."""

import torch
from torch import Tensor


def distances(means: Tensor, viewmats: Tensor, visible: Tensor) -> Tensor:
    """Euclidean distances between Gaussians and cameras, differentiable in both.

    Args:
        means: Centres, [..., N, 3], world units.
        viewmats: World to camera, [..., C, 4, 4].
        visible: Which Gaussians a camera draws, [..., C, N].

    Returns:
        [..., C, N], world units; 0 where a Gaussian is not drawn. In the dtype of ``means``; in between float64, as far
        from the origin the terms cancel.
    """
    rotations, translations = viewmats[..., :3, :3].double(), viewmats[..., :3, 3].double()
    seen = torch.where(visible[..., None], means.double().unsqueeze(-3), 0.0)
    positions = seen @ rotations.transpose(-1, -2) + translations.unsqueeze(-2)
    drawn = torch.where(visible[..., None], positions, 1.0)  # keeps the root's gradient finite where nothing is drawn
    lengths = torch.linalg.vector_norm(drawn, dim=-1)
    return torch.where(visible, lengths, 0.0).to(means.dtype)
