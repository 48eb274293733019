"""Rotations of vectors by quaternions."""

import torch
from torch import Tensor, nn


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [..., n, 3] by quaternions [n, 4] (wxyz, any length): v + 2w (u x v) + 2 u x (u x v)."""
    w, u = nn.functional.normalize(quats, dim=-1).split((1, 3), dim=-1)
    u = u.expand_as(vectors)
    uv = torch.linalg.cross(u, vectors)
    return vectors + 2.0 * (w * uv + torch.linalg.cross(u, uv))
