"""Rotations of vectors by quaternions."""

import math

import torch

from thermosplat.scene.rotation import rotate


def test_quaternions_turn_vectors() -> None:
    """A quarter turn about z takes x to y at any length of the quaternion; the identity turns nothing."""
    half = math.sqrt(0.5)
    quats = torch.tensor([[3 * half, 0.0, 0.0, 3 * half], [1.0, 0.0, 0.0, 0.0]])
    vectors = torch.tensor([[[1.0, 0.0, 2.0], [1.0, 2.0, 3.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]])
    expected = torch.tensor([[[0.0, 1.0, 2.0], [1.0, 2.0, 3.0]], [[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    torch.testing.assert_close(rotate(quats, vectors), expected, rtol=0, atol=1e-6)
