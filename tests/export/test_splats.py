"""What all formats share: which Gaussians are shown, how they are turned and sorted."""

import numpy as np
import torch

from splat_scenes import scene_like_splats
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_rendering import render_splats
from thermosplat.export.splats import SplatArrays, Splats, drawable, morton_order, turned_y_up

HALF_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def as_splats(arrays: SplatArrays) -> Splats:
    columns = [torch.from_numpy(getattr(arrays, name).copy()) for name in arrays.__dataclass_fields__]
    columns[4] = columns[4][:, None]
    return Splats(*columns)


def test_half_a_turn_moves_the_scene_and_not_its_image() -> None:
    """Turned Gaussians before a camera that is turned with them look the same: harmonics of all degrees, rotations."""
    original = drawable(scene_like_splats(60, 4))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 12.0
    K = torch.tensor([[60.0, 0.0, 24.0], [0.0, 60.0, 18.0], [0.0, 0.0, 1.0]])
    image = render_splats(as_splats(original), ViewTensors(viewmat, K, 48, 36))
    turned = render_splats(as_splats(turned_y_up(original)), ViewTensors(viewmat @ HALF_TURN, K, 48, 36))
    assert image.std() > 0.03
    torch.testing.assert_close(turned, image, rtol=1e-4, atol=1e-5)


def test_two_half_turns_are_none() -> None:
    """The turn is its own inverse, up to the sign of a quaternion."""
    original = drawable(scene_like_splats(20, 2))
    twice = turned_y_up(turned_y_up(original))
    np.testing.assert_array_equal(twice.means, original.means)
    np.testing.assert_array_equal(twice.shN, original.shN)
    np.testing.assert_allclose(np.abs((twice.quats * original.quats).sum(axis=1)), 1.0, rtol=1e-6)


def test_only_harmonics_in_use_are_kept() -> None:
    """Degrees that are zero everywhere are left out."""
    splats = scene_like_splats(20, 3)
    splats.shN[:, 3:] = 0.0
    shown = drawable(splats)
    assert shown.sh_degree == 1
    assert shown.shN.shape == (20, 3, 3)


def test_neighbours_in_morton_order_are_neighbours_in_space() -> None:
    """Along the curve of a grid of points steps are short; the order is a permutation."""
    axis = np.arange(8, dtype=np.float32)
    grid = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    points = grid[np.random.default_rng(0).permutation(len(grid))]
    order = morton_order(points)
    assert sorted(order) == list(range(512))
    steps = np.abs(np.diff(points[order], axis=0)).sum(axis=1)
    assert steps.mean() < 2.0 < np.abs(np.diff(points, axis=0)).sum(axis=1).mean()
    assert morton_order(np.zeros((0, 3), np.float32)).shape == (0,)
