"""Directions of pixels against the camera model."""

import math
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest
import torch

from rolling_captures import line_poses
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.datasets.readouts import LineOrder
from thermosplat.scene.view_directions import view_directions


def turned_view() -> ViewTensors:
    """A camera with a skewed principal point, turned about two axes."""
    a, b = 0.7, -0.4
    about_y = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    about_x = torch.tensor([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = about_x @ about_y, torch.tensor([0.3, -1.0, 2.0])
    K = torch.tensor([[20.0, 0.0, 5.5], [0.0, 25.0, 3.0], [0.0, 0.0, 1.0]])
    return ViewTensors(viewmat, K, 12, 8)


def test_points_along_a_direction_project_to_its_pixel() -> None:
    """Walking from the camera along a pixel's direction stays at the pixel's centre."""
    view = turned_view()
    directions = view_directions(view)
    assert directions.shape == (8, 12, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(8, 12))
    rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
    center = -rotation.T @ translation
    points = (center + 3.0 * directions) @ rotation.T + translation
    pixels = points @ view.K.T
    x, y = pixels[..., 0] / pixels[..., 2], pixels[..., 1] / pixels[..., 2]
    torch.testing.assert_close(x, (torch.arange(12) + 0.5).expand(8, 12), atol=1e-4, rtol=0)
    torch.testing.assert_close(y, (torch.arange(8) + 0.5)[:, None].expand(8, 12), atol=1e-4, rtol=0)
    assert (points[..., 2] > 0).all()


@pytest.mark.parametrize("order", get_args(LineOrder))
def test_each_line_looks_from_the_pose_at_its_time(order: LineOrder) -> None:
    """During a turn of 5 degrees, pixels look where those of a camera at rest would, to 0.06 degrees."""
    motion = np.stack([np.eye(4), np.eye(4)])
    for half, pose in zip((-2.5, 2.5), motion, strict=True):
        pose[:3, :3] = cv2.Rodrigues(np.radians(half) * np.array([0.6, -0.64, 0.48]))[0]
    view = replace(turned_view(), readout=torch.tensor(motion, dtype=torch.float32), line_order=order)
    directions = view_directions(view)
    for line, pose in enumerate(line_poses(view)):
        still = view_directions(replace(view, readout=None, viewmat=torch.tensor(pose, dtype=torch.float32)))
        found, true = (seen[:, line] if view.line_order.count("left") else seen[line] for seen in (directions, still))
        torch.testing.assert_close(found.norm(dim=-1), torch.ones(len(found)))
        assert torch.rad2deg((found - true).norm(dim=-1)).max() < 0.06
    at_rest = view_directions(replace(view, readout=None))
    assert torch.rad2deg((directions - at_rest).norm(dim=-1)).max() > 1.0
