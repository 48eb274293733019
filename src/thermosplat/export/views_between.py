"""Cameras between those of a capture. There is no photograph from there, but the exact render can be asked for one."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors


class ViewsBetween:
    """Draws cameras at random places between a view and its nearest neighbours.

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

    def draw(self, index: int, generator: torch.Generator) -> ViewTensors:
        """A camera of the size and intrinsics of a view, between that view and its neighbours.

        Args:
            index: The view.
            generator: Draws the weights of the poses, evenly among all that sum to one.
        """
        chosen = self.nearest[index]
        weights = -torch.log(1.0 - torch.rand(len(chosen), generator=generator, dtype=torch.float64))
        weights = weights / weights.sum()
        center = weights @ self.centers[chosen]
        u, _, vh = torch.linalg.svd(torch.einsum("k,kij->ij", weights, self.rotations[chosen]))
        turned = u @ torch.diag(torch.tensor([1.0, 1.0, torch.linalg.det(u @ vh)], dtype=torch.float64)) @ vh
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = turned.T, -turned.T @ center
        view = self.views[index]
        return dataclasses.replace(view, viewmat=viewmat.to(view.viewmat), image=None, intensity=None, values=None)
