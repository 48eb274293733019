"""Rays of pixels, and Gaussians as rays meet them; torch differentiates both."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from thermosplat.rasterizer.arguments import CameraModel


def pixel_rays(
    viewmats: Tensor, Ks: Tensor, width: int, height: int, camera_model: CameraModel
) -> tuple[Tensor, Tensor]:
    """Origins and unit directions of the rays through all pixel centres.

    Args:
        viewmats: World to camera, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Of the images [px].
        height: Of the images [px].
        camera_model: "pinhole" or "ortho".

    Returns:
        Both in float64, [..., C, H, W, 3], world units.
    """
    back, K = torch.linalg.inv(viewmats.double()), Ks.double()
    x = (torch.arange(width, device=K.device) + 0.5 - K[..., 0, 2:]) / K[..., 0, :1]  # [..., C, W]
    y = (torch.arange(height, device=K.device) + 0.5 - K[..., 1, 2:]) / K[..., 1, 1:2]
    shape = (*x.shape[:-1], height, width)
    across, down = x.unsqueeze(-2).expand(shape), y.unsqueeze(-1).expand(shape)
    rotations = back[..., None, :3, :3]
    if camera_model == "ortho":
        places = torch.stack([across, down, torch.zeros_like(across)], -1)
        origins = places @ rotations.transpose(-1, -2) + back[..., None, None, :3, 3]
        directions = rotations[..., :, 2].unsqueeze(-2).expand(origins.shape)
    else:
        directions = torch.stack([across, down, torch.ones_like(across)], -1) @ rotations.transpose(-1, -2)
        origins = back[..., None, None, :3, 3].expand(directions.shape)
    return origins, normalize(directions, dim=-1)


def whitening(quats: Tensor, scales: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices that make Gaussians unit spheres, and Gaussians' third axes.

    Args:
        quats: [..., N, 4], wxyz, of any length; zero is the identity.
        scales: [..., N, 3], world units.
        visible: Of which Gaussians anything is read, [..., N]; the others are unit spheres.

    Returns:
        S⁻¹ Rᵀ, [..., N, 3, 3], and R's third column, [..., N, 3]; worked out in
        float64, in the dtype of the scales.
    """
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    w, x, y, z = normalize(torch.where(visible[..., None], quats, identity).double(), dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    rotations = torch.stack(rows, -2)
    safe = torch.where(visible[..., None], scales, 1.0).double()
    matrices = rotations.transpose(-1, -2) / safe[..., None]
    return matrices.to(scales.dtype), rotations[..., 2].to(scales.dtype)
