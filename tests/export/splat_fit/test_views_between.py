"""Cameras between those of a capture."""

import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_fit.fitted_splats import ViewsBetween


def view(x: float, degrees: float = 0.0) -> ViewTensors:
    """A camera at (x, 0, 0) that is turned about its y axis."""
    angle = torch.deg2rad(torch.tensor(degrees))
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[angle.cos(), 0.0, angle.sin()], [0.0, 1.0, 0.0], [-angle.sin(), 0.0, angle.cos()]])
    pose[0, 3] = x
    return ViewTensors(torch.linalg.inv(pose), torch.eye(3), 8, 6, image=torch.zeros(6, 8, 3))


def drawn(views: list[ViewTensors], index: int, count: int = 50, neighbors: int = 3) -> list[torch.Tensor]:
    """Poses of drawn cameras, camera to world."""
    between, generator = ViewsBetween(views, neighbors), torch.Generator().manual_seed(0)
    return [torch.linalg.inv(camera.viewmat) for camera in between.draw([index] * count, generator)]


def test_cameras_lie_between_neighbors() -> None:
    """They stand and look between the view and its nearest ones, not beyond, and not between views far apart."""
    views = [view(0.0, 0.0), view(1.0, 10.0), view(2.0, 20.0), view(50.0, 0.0)]
    poses = drawn(views, 0, neighbors=2)
    places = torch.stack([pose[0, 3] for pose in poses])
    assert 0.0 <= places.min() < 0.5
    assert 1.5 < places.max() <= 2.0
    forward = torch.stack([pose[:3, 2] for pose in poses])
    turned = torch.rad2deg(torch.atan2(forward[:, 0], forward[:, 2]))
    assert turned.min() >= -1e-3
    assert turned.max() <= 20.0 + 1e-3
    for pose in poses:
        torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), rtol=0, atol=1e-5)
        assert torch.linalg.det(pose[:3, :3]) > 0


def test_views_that_look_elsewhere_are_no_neighbors() -> None:
    """Of two views in one place the one that looks the same way is nearer."""
    views = [view(0.0, 0.0), view(0.1, 180.0), view(0.2, 5.0), view(3.0, 90.0)]
    forward = torch.stack([pose[:3, 2] for pose in drawn(views, 0, neighbors=1)])
    assert forward[:, 2].min() > 0.99


def test_a_single_view_is_its_own_neighbor() -> None:
    """Without others the camera is that of the view, without its image."""
    only = view(0.3, 20.0)
    (between,) = ViewsBetween([only]).draw([0], torch.Generator().manual_seed(0))
    torch.testing.assert_close(between.viewmat, only.viewmat, rtol=0, atol=1e-6)
    assert between.image is None
    assert (between.width, between.height) == (8, 6)
