"""Coordinates in which every number of a camera correction moves the image equally far.

A rotation of a camera and a translation across its view do nearly the same to an image, and what tells them apart is
small. A gradient step along such a pair goes to and fro across the valley instead of along it. So corrections are
learnt in coordinates z [px]: with J the Jacobian of the places where M points are seen, by the correction θ,

    θ = P z,    P = (JᵀJ / M + λ diag(JᵀJ / M))^-½,

and a unit of any z moves the seen points by about a pixel in the root mean square. This is CamP (Park et al. 2023) with
the points of the capture in place of random ones.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.refinement.camera_motion import seen_points

DAMPING = 0.01
"""λ. CamP has 0.1. Open choice: with 0.01 the weakest direction is learnt at most ten times as fast as it would be."""
FEWEST = 16
"""Points in view with which the capture's own are used."""
SMALL = 1e-6
"""Step of the central differences that give J: exact to 1e-9 in float64."""
MOST = 256
"""Points that are looked at, spread over those in view."""


def points_in_view(view: ViewTensors, points: Tensor, distance: float) -> Tensor:
    """Some points that a camera sees; where there are few, a grid of its pixels at some distance.

    Args:
        view: The camera, float64.
        points: Points of the capture [world units], shape [M, 3], float64.
        distance: Depth of the grid [world units].

    Returns:
        Shape [m, 3], m at most ``MOST``.
    """
    camera = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    places = (camera / camera[:, 2:]) @ view.K.T
    size = places.new_tensor([view.width, view.height])
    inside = (camera[:, 2] > 1e-3 * distance) & (places[:, :2] > 0).all(dim=1) & (places[:, :2] < size).all(dim=1)
    found = points[inside]
    if len(found) >= FEWEST:
        return found[:: -(-len(found) // MOST)]
    across = torch.linspace(0.0, 1.0, 8, dtype=points.dtype)
    x, y = torch.meshgrid(across * view.width, across * view.height, indexing="xy")
    rays = torch.stack([x.flatten(), y.flatten(), torch.ones(64, dtype=points.dtype)], dim=1) @ view.K.inverse().T
    return (distance * rays - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def normal_matrix(corrected: Callable[[Tensor], ViewTensors], size: int, points: Tensor) -> Tensor:
    """JᵀJ / M of the places where a camera sees points, by the numbers of its correction, at zero.

    Args:
        corrected: The camera for a correction, shape [size], float64.
        points: What it sees, shape [M, 3], float64.

    Returns:
        Shape [size, size].
    """
    steps = SMALL * torch.eye(size, dtype=torch.float64)
    columns = [seen_points(corrected(step), points) - seen_points(corrected(-step), points) for step in steps]
    jacobian = torch.stack(columns, dim=-1).reshape(-1, size) / (2 * SMALL)
    return jacobian.T @ jacobian / len(points)


def preconditioner(normal: Tensor) -> Tensor:
    """P of a normal matrix; numbers that move nothing get none.

    Args:
        normal: JᵀJ / M, shape [n, n], float64.

    Returns:
        Shape [n, n], symmetric.
    """
    moving = normal.diagonal() > 0
    result = torch.zeros_like(normal)
    kept = normal[moving][:, moving]
    damped = kept + DAMPING * kept.diagonal().diag()
    values, vectors = torch.linalg.eigh(damped)
    root = (vectors / values.sqrt()) @ vectors.T
    result[moving.nonzero(), moving.nonzero().T] = root
    return result
