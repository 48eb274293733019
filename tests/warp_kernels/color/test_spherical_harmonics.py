"""The SH basis by its defining property, and its adjoint by finite differences."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.color.spherical_harmonics import basis_functions

DTYPE = wp.float64
VEC3, VEC16 = wp.types.vector(3, DTYPE), wp.types.vector(16, DTYPE)
BASIS, BASIS_ADJOINT = basis_functions(DTYPE)


@wp.kernel(module="unique", enable_backward=False)
def evaluate_kernel(degree: int, directions: wp.array(dtype=VEC3), values: wp.array(dtype=VEC16)):
    """Basis values of each direction."""
    i = wp.tid()
    values[i] = BASIS(directions[i], degree)


@wp.kernel(module="unique", enable_backward=False)
def adjoint_kernel(
    degree: int, directions: wp.array(dtype=VEC3), v: wp.array(dtype=VEC16), v_directions: wp.array(dtype=VEC3)
):
    """Gradient to each direction."""
    i = wp.tid()
    v_directions[i] = BASIS_ADJOINT(directions[i], degree, v[i])


def evaluate(directions: np.ndarray, degree: int) -> np.ndarray:
    """Basis values [n, 16]."""
    values = wp.zeros(len(directions), dtype=VEC16, device="cpu")
    inputs = [degree, wp.array(directions, dtype=VEC3, device="cpu"), values]
    wp.launch(evaluate_kernel, dim=len(directions), inputs=inputs, device="cpu")
    return values.numpy()


def sphere_quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials of degree 6 over the unit sphere exactly."""
    heights, height_weights = np.polynomial.legendre.leggauss(4)
    turns = np.arange(8) * 2 * np.pi / 8
    z, turn = np.meshgrid(heights, turns, indexing="ij")
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], -1).reshape(-1, 3)
    return directions, np.repeat(height_weights, 8) * 2 * np.pi / 8


def test_basis_is_orthonormal() -> None:
    """The 16 functions are orthonormal on the sphere, which fixes every constant in them."""
    directions, weights = sphere_quadrature()
    values = evaluate(directions, 3)
    gram = (values * weights[:, None]).T @ values
    assert np.abs(gram - np.eye(16)).max() < 1e-14


def test_order_and_signs_are_those_of_3dgs() -> None:
    """Band 1 is (-y, z, -x); bands 2 and 3 start with xy and end as 3DGS orders them."""
    x, y, z = 0.48, -0.6, 0.64
    value = evaluate(np.array([[x, y, z]]), 3)[0]
    assert np.allclose(value[1:4], 0.4886025119029199 * np.array([-y, z, -x]), rtol=1e-14)
    assert np.allclose(value[[4, 5, 7]], 1.0925484305920792 * np.array([x * y, -y * z, -x * z]), rtol=1e-14)
    assert np.isclose(value[8], 0.5462742152960396 * (x * x - y * y), rtol=1e-14)
    assert np.isclose(value[10], 2.890611442640554 * x * y * z, rtol=1e-14)
    assert np.isclose(value[15], -0.5900435899266435 * x * (x * x - 3 * y * y), rtol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bands_above_the_degree_are_zero(degree: int) -> None:
    """A lower degree evaluates the same functions and leaves the rest zero."""
    directions, _ = sphere_quadrature()
    full, some = evaluate(directions, 3), evaluate(directions, degree)
    active = (degree + 1) ** 2
    assert (some[:, :active] == full[:, :active]).all()
    assert (some[:, active:] == 0).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_adjoint_equals_finite_differences(degree: int) -> None:
    """The gradient of every basis function with respect to the direction."""
    directions, _ = sphere_quadrature()
    v = np.random.default_rng(0).normal(size=(len(directions), 16))
    found = wp.zeros(len(directions), dtype=VEC3, device="cpu")
    arrays = [wp.array(directions, dtype=VEC3, device="cpu"), wp.array(v, dtype=VEC16, device="cpu")]
    wp.launch(adjoint_kernel, dim=len(directions), inputs=[degree, *arrays, found], device="cpu")
    step = 1e-6
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        difference = (evaluate(directions + shift, degree) - evaluate(directions - shift, degree)) / (2 * step)
        assert np.abs(found.numpy()[:, axis] - (difference * v).sum(-1)).max() < 1e-8
