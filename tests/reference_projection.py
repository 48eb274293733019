"""Projection and colour of the dense reference rasterizer: EWA in plain torch, differentiated by autograd.

Gaussians that a camera does not see get exactly zero gradients, never NaN, whatever their numbers are.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

ALPHA_MIN = 1.0 / 255.0  # a Gaussian fainter than this in a pixel is skipped there
MAX_EXTENT = 3.33  # [standard deviations] where alpha of an opaque Gaussian falls below ALPHA_MIN
FOV_MARGIN = 0.3  # of tan(fov / 2), beyond each image border
MARGIN = 1e-4  # relative distance to a threshold that counts as uncertain


class ProjectedGaussians(NamedTuple):
    """Gaussians as seen by B*C cameras; invisible ones hold harmless numbers."""

    visible: Tensor  # [B, C, N] bool
    marginal: Tensor  # [B, C, N] bool: lower precision may decide otherwise
    radii: Tensor  # [B, C, N, 2] int32 [px], 0 where invisible
    means2d: Tensor  # [B, C, N, 2] [px]
    conics: Tensor  # [B, C, N, 3]
    depths: Tensor  # [B, C, N]
    compensations: Tensor  # [B, C, N]


def flat_scene(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, viewmats: Tensor, Ks: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Leading batch dims become one; the geometry becomes means and covariances."""
    n, cameras, batches = means.shape[-2], viewmats.shape[-3], math.prod(means.shape[:-2])
    if covars is None:
        if quats is None or scales is None:
            raise ValueError("give quats and scales, or covars")
        # A zero quaternion counts as the identity, with no gradient, as torch's normalize has it.
        finite = torch.isfinite(quats).all(-1, keepdim=True) & torch.isfinite(scales).all(-1, keepdim=True)
        turned = rotation_matrices(normalize(torch.where(finite, quats, 0.0), dim=-1))
        turned = turned * torch.where(finite, scales, 1.0)[..., None, :]
        covars = torch.where(finite[..., None], turned @ turned.transpose(-1, -2), torch.nan)
    else:
        # gsplat reads the upper triangle only.
        covars = torch.triu(covars) + torch.triu(covars, 1).transpose(-1, -2)
    return (
        means.reshape(batches, n, 3),
        covars.reshape(batches, n, 3, 3),
        viewmats.reshape(batches, cameras, 4, 4),
        Ks.reshape(batches, cameras, 3, 3),
    )


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4] (wxyz)."""
    w, x, y, z = quats.unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def project(
    means: Tensor,
    covars: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    opacities: Tensor,
    valid: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    antialiased: bool,
    camera_model: str,
) -> ProjectedGaussians:
    """EWA projection of [B, N] Gaussians into [B, C] cameras; those not ``valid`` [B, 1 or C, N] are invisible.

    It runs twice: once to see which Gaussians are visible, and once with gradients, where the invisible ones are
    replaced by a harmless Gaussian *before* any arithmetic (0 * NaN is NaN, so masking afterwards is too late).
    """
    rotations, translations = viewmats[..., None, :3, :3], viewmats[..., None, :3, 3]
    focal = torch.stack([Ks[..., 0, 0], Ks[..., 1, 1]], -1)[..., None, :]  # [B, C, 1, 2]
    centre = torch.stack([Ks[..., 0, 2], Ks[..., 1, 2]], -1)[..., None, :]
    size = means.new_tensor([width, height])
    identity = torch.eye(3, dtype=means.dtype, device=means.device)
    ahead = means.new_tensor([0.0, 0.0, 1.0])

    def to_image(visible: Tensor | None) -> tuple[Tensor, ...]:
        world_means, world_covars = means[:, None], covars[:, None]
        if visible is not None:
            seen = visible.any(1)[:, None]  # finite, and seen by at least one camera of the batch
            world_means = torch.where(seen[..., None], world_means, 0.0)
            world_covars = torch.where(seen[..., None, None], world_covars, identity)
        camera_means = (rotations @ world_means[..., None])[..., 0] + translations
        camera_covars = rotations @ world_covars @ rotations.transpose(-1, -2)
        if visible is not None:
            camera_means = torch.where(visible[..., None], camera_means, ahead)
            camera_covars = torch.where(visible[..., None, None], camera_covars, identity)
        xy, depths = camera_means[..., :2], camera_means[..., 2]
        clamped = torch.zeros_like(depths, dtype=torch.bool)
        if camera_model == "pinhole":
            slopes = xy / depths[..., None]
            margin = FOV_MARGIN * 0.5 * size / focal
            highest, lowest = (size - centre) / focal + margin, -centre / focal - margin
            bounded = torch.minimum(torch.maximum(slopes, lowest), highest)
            clamped = (((slopes - highest).abs() < MARGIN) | ((slopes - lowest).abs() < MARGIN)).any(-1)
            means2d = focal * slopes + centre
            scale = focal / depths[..., None]
            third = -focal * bounded / depths[..., None]
        else:
            means2d = focal * xy + centre
            scale = focal.expand_as(xy)
            third = torch.zeros_like(xy)
        zero = torch.zeros_like(depths)
        jacobians = torch.stack(
            [
                torch.stack([scale[..., 0], zero, third[..., 0]], -1),
                torch.stack([zero, scale[..., 1], third[..., 1]], -1),
            ],
            -2,
        )
        covars2d = jacobians @ camera_covars @ jacobians.transpose(-1, -2)
        xx, xy_, yy = covars2d[..., 0, 0], covars2d[..., 0, 1], covars2d[..., 1, 1]
        sharp_det = xx * yy - xy_ * xy_
        xx, yy = xx + eps2d, yy + eps2d
        det = xx * yy - xy_ * xy_
        return means2d, depths, xx, xy_, yy, sharp_det, det, clamped

    with torch.no_grad():
        means2d, depths, xx, xy_, yy, sharp_det, det, clamped = to_image(None)
        compensations = (sharp_det / det).clamp(min=0.0).sqrt() if antialiased else torch.ones_like(det)
        effective = opacities * compensations
        extent = (2.0 * (effective / ALPHA_MIN).log()).sqrt().clamp(max=MAX_EXTENT)
        reach = extent[..., None] * torch.stack([xx, yy], -1).sqrt()
        radii = reach.ceil()
        inside = ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
        visible = (
            valid
            & torch.isfinite(torch.cat([means2d, reach, torch.stack([depths, xy_, det, effective], -1)], -1)).all(-1)
            & (depths >= near_plane)
            & (depths <= far_plane)
            & (det > 0)
            & (effective >= ALPHA_MIN)
            & (radii > radius_clip).any(-1)
            & inside
        )
        near_edge = ((depths / near_plane - 1).abs() < MARGIN) | ((depths / far_plane - 1).abs() < MARGIN)
        near_clip = (radius_clip > 0) & ((reach - reach.round()).abs() < MARGIN * reach).any(-1)
        marginal = clamped | near_edge | near_clip
        radii = torch.where(visible[..., None], radii, 0.0).to(torch.int32)

    means2d, depths, xx, xy_, yy, sharp_det, det, _ = to_image(visible)
    ratio = torch.where(visible, sharp_det / det, 1.0) if antialiased else torch.ones_like(det)
    # Visible Gaussians have a ratio above (1/255)^2; the floor keeps the root's gradient finite for the others.
    compensations = ratio.clamp(min=1e-12).sqrt()
    conics = torch.stack([yy / det, -xy_ / det, xx / det], -1)
    means2d = torch.where(visible[..., None], means2d, 0.0)
    return ProjectedGaussians(visible, marginal, radii, means2d, conics, depths, compensations)


def per_camera_values(colors: Tensor, batches: int, cameras: int, *, tail_dims: int, batch_dims: int) -> Tensor:
    """[..., N, *tail] or [..., C, N, *tail] as [B, C, N, *tail] (tail is [D] or [K, 3])."""
    n, tail = colors.shape[-tail_dims - 1], colors.shape[-tail_dims:]
    has_cameras = colors.dim() == batch_dims + 2 + tail_dims
    return colors.reshape(batches, cameras if has_cameras else 1, n, *tail).expand(batches, cameras, n, *tail)


def view_colors(coefficients: Tensor, means: Tensor, viewmats: Tensor, visible: Tensor, degree: int) -> Tensor:
    """RGB [B, C, N, 3] of SH coefficients [B, C, N, K, 3] seen from each camera."""
    positions = torch.linalg.inv(viewmats)[..., None, :3, 3]
    safe_means = torch.where(visible[..., None], means[:, None], positions.detach() + 1.0)
    basis = spherical_harmonics(normalize(safe_means - positions, dim=-1), degree)
    coefficients = torch.where(visible[..., None, None], coefficients[..., : basis.shape[-1], :], 0.0)
    return ((basis[..., None] * coefficients).sum(-2) + 0.5).clamp(min=0.0)


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real SH basis [..., (degree+1)^2] with the Condon-Shortley signs of 3DGS, written from its closed forms."""
    x, y, z = directions.unbind(-1)
    pi = torch.pi
    basis = [torch.full_like(x, (1 / (4 * pi)) ** 0.5)]
    if degree >= 1:
        c = (3 / (4 * pi)) ** 0.5
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = (15 / (4 * pi)) ** 0.5
        zonal = (5 / (16 * pi)) ** 0.5 * (3 * z * z - 1)
        basis += [c * x * y, -c * y * z, zonal, -c * x * z, c / 2 * (x * x - y * y)]
    if degree >= 3:
        a, b, c = (35 / (32 * pi)) ** 0.5, (105 / (4 * pi)) ** 0.5, (21 / (32 * pi)) ** 0.5
        zonal = (7 / (16 * pi)) ** 0.5 * z * (5 * z * z - 3)
        basis += [-a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (5 * z * z - 1), zonal]
        basis += [-c * x * (5 * z * z - 1), b / 2 * z * (x * x - y * y), -a * x * (x * x - 3 * y * y)]
    return torch.stack(basis, -1)
