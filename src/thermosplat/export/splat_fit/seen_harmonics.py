"""Harmonics of splats in coordinates that the cameras of a capture can tell apart.

Cameras see a splat from a few directions d_v, often all from one side. There the basis functions B(d) of the harmonics
nearly depend on each other, and steps along single coefficients are slow. With the mean over these directions

    G = mean_v B(d_v) B(d_v)^T + λ I = L L^T

the functions L⁻¹ B have a mean square of one and no correlation over the directions, and the colour of a splat is
their sum with coordinates z = L^T c in place of the coefficients c. The first coordinate is the colour that the
directions share, the others change it from camera to camera. Those are divided by ``CHANGES``, so that Adam, which
moves all numbers alike, moves them by so much less.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.fused.small_products import warp_small_products
from thermosplat.rasterizer.steps import spherical_harmonics

DAMPING = 1e-3
"""λ: what lies between directions that were seen is to change little where the directions themselves do not say it."""
CHANGES = 0.125
"""How fast a colour learns to change from camera to camera, of how fast it learns what all cameras see."""
MARGIN = 0.1
"""A splat is seen whose centre lies so far outside of the image at most, of the image's size."""
_CHUNK = 65536
"""Splats at a time: their matrices are in float64."""


class SeenHarmonics:
    """The change between coefficients and coordinates, of each splat its own.

    Args:
        means: Centres of the splats, [N, 3].
        views: The cameras, at least one.
        degree: Highest SH degree, 0 to 4.
    """

    def __init__(self, means: Tensor, views: Sequence[ViewTensors], degree: int) -> None:
        chunks = [_inverse_factors(chunk, views, degree) for chunk in means.split(_CHUNK)]
        self.from_coordinates = torch.cat(chunks) if chunks else means.new_zeros(0, 1, 1)
        self.from_coordinates[:, :, 1:] *= CHANGES
        """L^-T, its columns after the first times ``CHANGES``, [N, K, K]."""

    def coefficients(self, coordinates: Tensor) -> Tensor:
        """SH coefficients [N, K, 3] of coordinates [N, K, 3], to which gradients flow."""
        if coordinates.is_cuda:
            return warp_small_products(self.from_coordinates, coordinates)
        return self.from_coordinates @ coordinates

    def coordinates(self, coefficients: Tensor) -> Tensor:
        """Coordinates [N, K, 3] of SH coefficients [N, K, 3]."""
        found = torch.linalg.solve_triangular(self.from_coordinates, coefficients, upper=True)
        return found.contiguous()  # column by column, as it comes from there


@torch.no_grad()
def _inverse_factors(means: Tensor, views: Sequence[ViewTensors], degree: int) -> Tensor:
    """L^-T of some splats, [n, K, K]."""
    count = (degree + 1) ** 2
    unit = torch.eye(count, device=means.device)
    gram = torch.zeros(len(means), count, count, dtype=torch.float64, device=means.device)
    seen = torch.zeros(len(means), dtype=torch.float64, device=means.device)
    for view in views:
        rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
        directions = torch.nn.functional.normalize(means + rotation.T @ translation, dim=-1)
        basis = spherical_harmonics(degree, directions, unit.expand(len(means), count, count)).double()
        inside = _inside(means @ rotation.T + translation, view)
        gram += torch.einsum("n,ni,nj->nij", inside.double(), basis, basis)
        seen += inside
    gram = gram / seen.clamp(min=1.0)[:, None, None] + DAMPING * unit.double()
    gram[seen == 0] = unit.double() / (4.0 * math.pi)  # from everywhere
    upper = torch.linalg.cholesky(gram).mT
    return torch.linalg.solve_triangular(upper, unit.double().expand_as(gram), upper=True).float()


def _inside(in_camera: Tensor, view: ViewTensors) -> Tensor:
    """Mask [n] of the points [n, 3] in camera axes that lie in front of a camera and in its image or beside it."""
    depths = in_camera[:, 2]
    pixels = (in_camera @ view.K.T)[:, :2] / depths[:, None].clamp(min=1e-9)
    size = torch.tensor([view.width, view.height], device=pixels.device)
    return (depths > 0) & ((pixels / size - 0.5).abs() <= 0.5 + MARGIN).all(dim=-1)
