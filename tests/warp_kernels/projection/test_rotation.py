"""Quaternions to rotation matrices and back through the adjoint."""

import numpy as np
import pytest
import torch
import warp as wp
from torch.nn.functional import normalize as torch_normalize

from reference_projection import rotation_matrices
from warp_kernels.projection.rotation import rotation_functions


def run(quats: np.ndarray, v: np.ndarray, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of the quaternions, and the gradient to the quaternions for the matrix gradients v."""
    vec3, vec4, mat33 = wp.types.vector(3, dtype), wp.types.vector(4, dtype), wp.types.matrix((3, 3), dtype)
    to_matrix, turn_adjoint = rotation_functions(dtype)

    @wp.kernel(module="unique", enable_backward=False, name=f"rotate_{dtype.__name__}")
    def rotate(q: wp.array(dtype=vec4), v: wp.array(dtype=mat33), R: wp.array(dtype=mat33), v_q: wp.array(dtype=vec4)):
        i = wp.tid()
        R[i] = mat33(to_matrix(q[i]))
        v_turn = vec3()
        for row in range(3):  # of R (I + [δ]x): a row r becomes r - δ x r
            v_turn = v_turn + wp.cross(v[i][row], R[i][row])
        v_q[i] = turn_adjoint(q[i], v_turn)

    n = len(quats)
    R, v_q = wp.zeros(n, dtype=mat33, device="cpu"), wp.zeros(n, dtype=vec4, device="cpu")
    arrays = [wp.array(quats, dtype=vec4, device="cpu"), wp.array(v, dtype=mat33, device="cpu")]
    wp.launch(rotate, dim=n, inputs=[*arrays, R, v_q], device="cpu")
    return R.numpy(), v_q.numpy()


@pytest.mark.parametrize(("dtype", "tolerance"), [(wp.float32, 2e-6), (wp.float64, 1e-14)])
def test_matrix_and_adjoint(dtype: type, tolerance: float) -> None:
    """Matrices equal the textbook formula, gradients equal autograd's through the normalisation."""
    quats = torch.randn(50, 4, dtype=torch.float64, requires_grad=True)
    v = torch.randn(50, 3, 3, dtype=torch.float64)
    truth = rotation_matrices(torch_normalize(quats, dim=-1))
    (v_truth,) = torch.autograd.grad(truth, quats, v)
    R, v_q = run(quats.detach().numpy(), v.numpy(), dtype)
    assert np.abs(R - truth.detach().numpy()).max() < tolerance
    assert np.abs(v_q - v_truth.numpy()).max() < tolerance * v_truth.abs().max().item()


def test_matrix_is_rounded_once() -> None:
    """In float32 to half a unit in the last place; by way of a unit quaternion it would be six."""
    quats = np.random.default_rng(1).normal(size=(1000, 4)).astype(np.float32)
    truth = rotation_matrices(torch_normalize(torch.from_numpy(quats).double(), dim=-1)).numpy()
    R, _ = run(quats, np.zeros((1000, 3, 3)), wp.float32)
    assert (np.abs(R - truth) <= 0.5 * np.spacing(np.abs(R)) + 1e-14).all()


def test_any_length() -> None:
    """Rotations do not depend on the quaternion's length, even where its square leaves float32's range."""
    quats = np.random.default_rng(0).normal(size=(6, 4))
    v = np.zeros((6, 3, 3))
    unit, _ = run(quats, v, wp.float32)
    for size in (1e-25, 1e-10, 1e10, 1e25):
        scaled, _ = run(quats * size, v, wp.float32)
        assert np.abs(scaled - unit).max() < 2e-6
    assert np.abs(unit @ unit.transpose(0, 2, 1) - np.eye(3)).max() < 1e-6


def test_zero_quaternion_is_the_identity() -> None:
    """With a zero gradient."""
    R, v_q = run(np.zeros((1, 4)), np.ones((1, 3, 3)), wp.float32)
    assert (R[0] == np.eye(3)).all()
    assert (v_q == 0).all()
