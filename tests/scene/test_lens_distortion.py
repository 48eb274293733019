"""A lens bends a pinhole image where COLMAP's RADIAL model says, and gradients reach the lens."""

import numpy as np
import pycolmap
import torch

from thermosplat.scene.lens_distortion import distorted, nearest_distorted, undistorted_positions

K = torch.tensor([[30.0, 0.0, 20.0], [0.0, 28.0, 15.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_positions_are_those_of_colmap() -> None:
    """COLMAP projects the undistorted ray of every pixel back to that pixel."""
    coefficients = torch.tensor([-0.05, 0.02], dtype=torch.float64)
    positions = undistorted_positions(31, 40, K, coefficients).numpy()
    rays = (positions - K[:2, 2].numpy()) / K.diagonal()[:2].numpy()
    lens = pycolmap.Camera(model="OPENCV", params=[30.0, 28.0, 20.0, 15.5, -0.05, 0.02, 0, 0], width=40, height=31)
    seen = lens.img_from_cam(np.dstack([rays, np.ones((31, 40, 1))]).reshape(-1, 3)).reshape(31, 40, 2)
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(31) + 0.5)
    np.testing.assert_allclose(seen, np.dstack([x, y]), atol=2e-4)


def test_a_lens_without_distortion_changes_nothing() -> None:
    """Zero coefficients sample every pixel at its own centre."""
    image = torch.rand(9, 12, 4, dtype=torch.float64)
    torch.testing.assert_close(distorted(image, K, torch.zeros(2, dtype=torch.float64)), image)


def test_a_smooth_image_is_resampled_where_the_lens_looks() -> None:
    """A plane of brightness gives the undistorted positions back."""
    x = torch.arange(40, dtype=torch.float64).add(0.5).expand(31, 40)
    coefficients = torch.tensor([0.03, 0.0], dtype=torch.float64)
    found = distorted(x[..., None].contiguous(), K, coefficients)[..., 0]
    expected = undistorted_positions(31, 40, K, coefficients)[..., 0]
    inside = np.s_[4:-4, 4:-4]
    torch.testing.assert_close(found[inside], expected[inside], atol=1e-6, rtol=0)


def test_depths_are_those_of_one_pixel() -> None:
    """No depth between two surfaces is invented."""
    depth = torch.arange(31 * 40, dtype=torch.float64).reshape(31, 40)
    found = nearest_distorted(depth, K, torch.tensor([0.08, 0.0], dtype=torch.float64))
    assert set(found.flatten().tolist()) <= set(depth.flatten().tolist())
    assert not torch.equal(found, depth)
    assert torch.equal(nearest_distorted(depth, K, torch.zeros(2, dtype=torch.float64)), depth)


def test_gradients_reach_image_intrinsics_and_coefficients() -> None:
    """As finite differences say."""
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(7, 8, 2, dtype=torch.float64, generator=generator)
    small = torch.tensor([[6.0, 0.0, 4.0], [0.0, 6.0, 3.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    inputs = (image, small, torch.tensor([0.031, -0.02], dtype=torch.float64))
    assert torch.autograd.gradcheck(distorted, [value.clone().requires_grad_() for value in inputs])
