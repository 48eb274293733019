"""Positions of cameras from their view matrices, and the adjoint of that."""

import numpy as np
import torch
import warp as wp

from warp_kernels.color.camera_positions import camera_position_kernels

IMAGES = 3


def view_matrices() -> torch.Tensor:
    """Views whose 3x3 part is no rotation, as that of a scaled scene."""
    generator = torch.Generator().manual_seed(1)
    views = torch.eye(4, dtype=torch.float64).repeat(IMAGES, 1, 1)
    views[:, :3] += 0.3 * torch.randn(IMAGES, 3, 4, generator=generator, dtype=torch.float64)
    return views


def test_positions_are_where_the_view_is_zero() -> None:
    """V p = e4, to the last bits of float64 for float64 and float32 matrices alike."""
    for dtype, mat44 in ((wp.float64, wp.mat44d), (wp.float32, wp.mat44f)):
        views = view_matrices().to(wp.dtype_to_torch(dtype))
        positions = wp.empty(IMAGES, dtype=wp.vec3d, device="cpu")
        inputs = [wp.array(views.numpy(), dtype=mat44, device="cpu")]
        wp.launch(camera_position_kernels(dtype)[0], IMAGES, inputs, [positions], device="cpu")
        expected = torch.linalg.inv(views.double())[:, :3, 3]
        np.testing.assert_allclose(positions.numpy(), expected, rtol=1e-12, atol=1e-12)


def test_adjoint_adds_the_gradient_through_the_inverse() -> None:
    """Against torch's, for a loss linear in the directions; what was there before stays."""
    views = view_matrices().requires_grad_()
    sums = torch.randn(IMAGES, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    positions = torch.linalg.inv(views)[:, :3, 3]
    (-sums * positions).sum().backward()  # directions are of differences mean - position
    gradients = wp.full(IMAGES, wp.mat44d(*[0.5] * 16), dtype=wp.mat44d, device="cpu")
    inputs = [
        wp.array(sums.numpy(), dtype=wp.vec3d, device="cpu"),
        wp.array(views.detach().numpy(), dtype=wp.mat44d, device="cpu"),
    ]
    wp.launch(camera_position_kernels(wp.float64)[1], IMAGES, inputs, [gradients], device="cpu")
    np.testing.assert_allclose(gradients.numpy() - 0.5, views.grad, rtol=1e-9, atol=1e-9)
