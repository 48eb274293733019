"""Small motions of cameras: proper rotations, rigid motions, lenses, and what is then seen."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.refinement.camera_motion import (
    moved_camera,
    moved_frame,
    rigid_motion,
    rotation_matrix,
    seen_points,
    with_focal_factor,
)

MOTION = torch.tensor([0.1, -0.2, 0.05, 0.3, 0.1, -0.4], dtype=torch.float64)
EXTENT = 2.0


@pytest.fixture
def view() -> ViewTensors:
    """A camera that is turned and off the origin."""
    viewmat = rigid_motion(torch.tensor([0.3, 0.5, -0.2, 0.1, 0.2, 2.0], dtype=torch.float64), 1.0)
    K = torch.tensor([[30.0, 0.0, 20.0], [0.0, 28.0, 15.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return ViewTensors(viewmat, K, 40, 31)


def test_rotation_of_a_rotation_vector() -> None:
    """A proper rotation, about r, by |r| to first order; zero gives the identity exactly."""
    r = torch.tensor([0.02, -0.01, 0.03], dtype=torch.float64)
    matrix = rotation_matrix(r)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(matrix).item() == pytest.approx(1.0)
    torch.testing.assert_close(matrix @ r, r)
    angle = torch.arccos((matrix.trace() - 1) / 2).item()
    assert angle == pytest.approx(2 * np.arctan(r.norm().item() / 2))
    assert torch.equal(rotation_matrix(torch.zeros(3)), torch.eye(3))
    assert torch.autograd.gradcheck(rotation_matrix, r.clone().requires_grad_())


def test_a_frame_moves_as_a_whole(view: ViewTensors) -> None:
    """Its first camera turns about its centre and moves along the world's axes; what lies between the cameras stays."""
    other = moved_camera(view, torch.tensor([0.0, 0.1, 0.0, 0.05, 0.0, 0.0], dtype=torch.float64), EXTENT)
    before = {"a": view, "b": other}
    center = view.viewmat.inverse()[:3, 3]
    after = moved_frame(before, MOTION, center, EXTENT)
    poses, moved = ({name: v.viewmat.inverse() for name, v in views.items()} for views in (before, after))
    torch.testing.assert_close(moved["a"][:3, 3], center + EXTENT * MOTION[3:])
    torch.testing.assert_close(moved["a"][:3, :3], rotation_matrix(MOTION[:3]) @ poses["a"][:3, :3])
    torch.testing.assert_close(moved["a"].inverse() @ moved["b"], poses["a"].inverse() @ poses["b"])
    still = moved_frame(before, torch.zeros_like(MOTION), center, EXTENT)
    assert torch.equal(still["b"].viewmat, other.viewmat)


def test_a_camera_moves_in_its_own_axes(view: ViewTensors) -> None:
    """What it saw at x it sees at R x + t."""
    point = torch.tensor([0.1, -0.2, 0.3, 1.0], dtype=torch.float64)
    seen = (view.viewmat @ point)[:3]
    found = (moved_camera(view, MOTION, EXTENT).viewmat @ point)[:3]
    torch.testing.assert_close(found, rotation_matrix(MOTION[:3]) @ seen + EXTENT * MOTION[3:])


def test_points_are_seen_where_colmap_sees_them(view: ViewTensors) -> None:
    """With a focal factor and distortion."""
    bent = with_focal_factor(view, torch.tensor(np.log(1.1)))
    bent = ViewTensors(bent.viewmat, bent.K, 40, 31, distortion=torch.tensor([-0.1, 0.04], dtype=torch.float64))
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    lens = pycolmap.Camera(model="OPENCV", params=[33.0, 30.8, 20.0, 15.5, -0.1, 0.04, 0, 0], width=40, height=31)
    local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    np.testing.assert_allclose(seen_points(bent, points), lens.img_from_cam(local.numpy()), rtol=1e-9)


class OneDevice(TorchDispatchMode):
    """Fails where an operation makes a tensor on another device than the one that all is to stay on."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = torch.device(device)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do the operation, and look where its result lies."""
        made = func(*args, **(kwargs or {}))
        assert not isinstance(made, torch.Tensor) or made.device == self.device, f"{func} makes a tensor elsewhere"
        return made


@pytest.mark.parametrize(
    "change",
    [
        lambda view, motion: moved_camera(view, motion, EXTENT),
        lambda view, motion: moved_frame({"rgb": view}, motion, motion[3:], EXTENT),
        lambda view, motion: with_focal_factor(view, motion[0]),
    ],
)
def test_nothing_is_copied_to_the_device(view: ViewTensors, change: Callable[..., Any]) -> None:
    """A step that is captured in a CUDA graph can copy nothing from the host."""
    there = replace(view, viewmat=view.viewmat.to("meta"), K=view.K.to("meta"))
    motion = MOTION.to("meta")
    with OneDevice("meta"):
        change(there, motion)
