"""Coordinates of corrections in pixels."""

import torch

from thermosplat.refinement.camera_corrections import camera_tensors
from thermosplat.refinement.camera_motion import moved_camera, seen_points
from thermosplat.refinement.preconditioning import DAMPING, normal_matrix, points_in_view, preconditioner
from toy_scene import toy_capture


def test_every_coordinate_moves_the_points_by_a_pixel() -> None:
    """In the root mean square; the weak ones, which damping holds, by less, and no two do the same."""
    capture = toy_capture()
    view = camera_tensors(capture.train[0].views["rgb"])
    points = points_in_view(view, torch.from_numpy(capture.points).double(), capture.scene_extent)
    assert len(points) >= 16
    normal = normal_matrix(lambda theta: moved_camera(view, theta, 1.0), 6, points)
    basis = preconditioner(normal)
    torch.testing.assert_close(basis, basis.T)
    whitened = basis @ normal @ basis
    values = torch.linalg.eigvalsh(whitened)
    assert values.max() <= 1.0
    assert values.max() > 1.0 / (1.0 + 2 * DAMPING)
    raw = torch.linalg.eigvalsh(normal / normal.diagonal().sqrt().outer(normal.diagonal().sqrt()))
    assert values.min() > 20 * raw.min()  # the valley between turning and shifting is as good as gone
    step = 0.01 * torch.linalg.eigh(whitened)[1][:, -1]
    shift = seen_points(moved_camera(view, basis @ step, 1.0), points) - seen_points(view, points)
    torch.testing.assert_close(shift.square().sum(dim=1).mean().sqrt().item(), 0.01, atol=2e-4, rtol=0)


def test_what_moves_nothing_gets_nothing() -> None:
    """Numbers that are not refined have no direction, and the others are as they would be without them."""
    normal = torch.tensor([[4.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]], dtype=torch.float64)
    found = preconditioner(normal)
    assert not found[1].any()
    assert not found[:, 1].any()
    torch.testing.assert_close(found[::2, ::2], preconditioner(normal[::2, ::2]))


def test_few_points_are_replaced_by_a_grid() -> None:
    """Rays through all of the image, at the given depth."""
    view = camera_tensors(toy_capture(aligned=False).train[0].views["thermal"])
    points = points_in_view(view, torch.zeros(0, 3, dtype=torch.float64), 3.0)
    depth = (points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3])[:, 2]
    torch.testing.assert_close(depth, torch.full((64,), 3.0, dtype=torch.float64))
    seen = seen_points(view, points)
    torch.testing.assert_close(seen.amin(dim=0), torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(seen.amax(dim=0), torch.tensor([view.width, view.height], dtype=torch.float64))
