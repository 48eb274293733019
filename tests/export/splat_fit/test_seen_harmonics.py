"""Coordinates of harmonics that the cameras of a capture can tell apart."""

import pytest
import torch

from splat_scenes import scene_like_splats
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_fit.seen_harmonics import CHANGES, DAMPING, SeenHarmonics
from thermosplat.export.splats import Splats


def camera(x: float) -> ViewTensors:
    """A camera at (x, 0, -6) that looks along the third axis."""
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([x, 0.0, -6.0])
    return ViewTensors(
        torch.linalg.inv(pose), torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]), 64, 48
    )


ARC = [camera(0.4 * place - 1.0) for place in range(6)]


def linear_basis(means: torch.Tensor, views: list[ViewTensors]) -> torch.Tensor:
    """Basis functions of degrees 0 and 1 towards each mean, [N, V, 4], in float64 (3DGS's signs and order)."""
    rows = []
    for view in views:
        center = torch.linalg.inv(view.viewmat.double())[:3, 3]
        x, y, z = torch.nn.functional.normalize(means.double() - center, dim=-1).unbind(-1)
        rows.append(torch.stack([torch.full_like(x, 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x], -1))
    return torch.stack(rows, dim=1)


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_there_and_back(degree: int) -> None:
    """Coefficients become coordinates and the same coefficients again."""
    splats = scene_like_splats(50, 4)
    coefficients = torch.cat([splats.sh0, splats.shN], dim=1)[:, : (degree + 1) ** 2]
    seen = SeenHarmonics(splats.means, ARC, degree)
    again = seen.coefficients(seen.coordinates(coefficients))
    torch.testing.assert_close(again, coefficients, rtol=1e-4, atol=1e-4)


def test_functions_of_the_coordinates_are_uncorrelated() -> None:
    """Their mean products over the cameras are one and zero, but for the damping; those of the harmonics are not."""
    means = torch.tensor([[0.0, 0.0, 0.0], [0.6, -0.4, 0.5]])
    seen = SeenHarmonics(means, ARC, 1)
    basis = linear_basis(means, ARC)
    undivided = seen.from_coordinates.double() / torch.tensor([1.0, CHANGES, CHANGES, CHANGES])
    functions = basis @ undivided
    undamped = torch.einsum("nvi,nvj->nij", functions, functions) / len(ARC)
    damping = DAMPING * undivided.mT @ undivided
    identity = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    torch.testing.assert_close(undamped + damping, identity, rtol=0, atol=1e-3)
    plain = torch.einsum("nvi,nvj->nij", basis, basis) / len(ARC)
    assert (plain[:, 0, 2] / (plain[:, 0, 0] * plain[:, 2, 2]).sqrt()).min() > 0.99  # of one side: nearly the same


def test_cameras_that_do_not_see_a_splat_do_not_count() -> None:
    """Cameras with their backs to a splat, or whose image it is far outside of, change nothing."""
    means = torch.tensor([[0.1, 0.2, 0.0]])
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera(0.3).viewmat
    far = camera(30.0)
    behind = ViewTensors(away, far.K, far.width, far.height)
    alone, among = SeenHarmonics(means, ARC, 2), SeenHarmonics(means, [*ARC, behind, far], 2)
    torch.testing.assert_close(among.from_coordinates, alone.from_coordinates, rtol=0, atol=0)


def test_splats_that_no_camera_sees_have_coordinates() -> None:
    """They are finite, and those of harmonics whose mean square from everywhere is one."""
    unseen = SeenHarmonics(torch.tensor([[0.0, 0.0, -50.0]]), ARC, 1)
    expected = torch.diag(torch.tensor([1.0, CHANGES, CHANGES, CHANGES]))[None] * 12.5663706**0.5
    torch.testing.assert_close(unseen.from_coordinates, expected, rtol=1e-5, atol=1e-5)


def test_no_splats() -> None:
    """A scene without Gaussians has none to change."""
    none = Splats(*(value[:0] for value in vars(scene_like_splats(3, 1)).values()))
    seen = SeenHarmonics(none.means, ARC, 1)
    assert seen.coordinates(torch.zeros(0, 4, 3)).shape == (0, 4, 3)
