"""Cameras between those of a capture. There is no photograph from there, but the exact render can be asked for one."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors


class ViewsBetween:
    """Draws cameras at random places between views and their nearest neighbours.

    Args:
        views: The capture's, at least one.
        neighbors: How many neighbours to stay between; fewer where there are fewer views.
    """

    def __init__(self, views: Sequence[ViewTensors], neighbors: int = 3) -> None:
        self.views = views
        poses = torch.linalg.inv(torch.stack([view.viewmat for view in views]).double().cpu())  # camera to world
        self.rotations, self.centers = poses[:, :3, :3], poses[:, :3, 3]
        self.nearest = self._nearest(min(neighbors, len(views) - 1))

    def _nearest(self, count: int) -> Tensor:
        """Indices [V, 1 + count] of each view, itself first, then those nearest in place and viewing direction."""
        spread = (self.centers - self.centers.mean(dim=0)).square().sum(dim=1).mean().sqrt().clamp(min=1e-12)
        places = torch.cat([self.centers / spread, self.rotations[:, :, 2]], dim=1)  # the third axis looks forward
        distances = torch.cdist(places, places).fill_diagonal_(-1.0)  # where views coincide, each is its own first
        return distances.argsort(dim=1)[:, : 1 + count]

    def draw(self, indices: Sequence[int], generator: torch.Generator) -> list[ViewTensors]:
        """Cameras of the size and intrinsics of views, each between one view and its neighbours.

        Args:
            indices: The views, n of them.
            generator: Draws the weights of the poses, evenly among all that sum to one.

        Returns:
            n cameras.
        """
        chosen = self.nearest[list(indices)]
        weights = -torch.log(1.0 - torch.rand(chosen.shape, generator=generator, dtype=torch.float64))
        weights = weights / weights.sum(dim=1, keepdim=True)
        centers = torch.einsum("nk,nki->ni", weights, self.centers[chosen])
        u, _, vh = torch.linalg.svd(torch.einsum("nk,nkij->nij", weights, self.rotations[chosen]))
        u[:, :, 2] *= torch.linalg.det(u @ vh)[:, None]  # the nearest rotation is no reflection
        to_camera = (u @ vh).mT
        viewmats = torch.eye(4, dtype=torch.float64).repeat(len(chosen), 1, 1)
        viewmats[:, :3, :3] = to_camera
        viewmats[:, :3, 3] = -torch.einsum("nij,nj->ni", to_camera, centers)
        on_device = viewmats.to(self.views[0].viewmat).unbind()
        return [
            dataclasses.replace(self.views[index], viewmat=viewmat, image=None, intensity=None, values=None)
            for index, viewmat in zip(indices, on_device, strict=True)
        ]
