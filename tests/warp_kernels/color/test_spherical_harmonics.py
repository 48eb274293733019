"""The SH basis by its defining property, and its adjoint by finite differences."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.color.harmonic_basis import ALL, FEW, basis_functions

DTYPE = wp.float64
VEC3, VALUES = wp.types.vector(3, DTYPE), wp.types.vector(ALL, DTYPE)
BASIS, BASIS_ADJOINT = basis_functions(DTYPE, ALL)
FEW_BASIS, FEW_ADJOINT = basis_functions(DTYPE, FEW)
FEW_VALUES = wp.types.vector(FEW, DTYPE)


@wp.kernel(module="unique", enable_backward=False)
def evaluate_kernel(degree: int, directions: wp.array(dtype=VEC3), values: wp.array(dtype=VALUES)):
    """Basis values of each direction."""
    i = wp.tid()
    values[i] = BASIS(directions[i], degree)


@wp.kernel(module="unique", enable_backward=False)
def adjoint_kernel(
    degree: int, directions: wp.array(dtype=VEC3), v: wp.array(dtype=VALUES), v_directions: wp.array(dtype=VEC3)
):
    """Gradient to each direction."""
    i = wp.tid()
    v_directions[i] = BASIS_ADJOINT(directions[i], degree, v[i])


def evaluate(directions: np.ndarray, degree: int) -> np.ndarray:
    """Basis values [n, 25]."""
    values = wp.zeros(len(directions), dtype=VALUES, device="cpu")
    inputs = [degree, wp.array(directions, dtype=VEC3, device="cpu"), values]
    wp.launch(evaluate_kernel, dim=len(directions), inputs=inputs, device="cpu")
    return values.numpy()


def sphere_quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials of degree 8 over the unit sphere exactly."""
    heights, height_weights = np.polynomial.legendre.leggauss(5)
    turns = np.arange(10) * 2 * np.pi / 10
    z, turn = np.meshgrid(heights, turns, indexing="ij")
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], -1).reshape(-1, 3)
    return directions, np.repeat(height_weights, 10) * 2 * np.pi / 10


def test_basis_is_orthonormal() -> None:
    """The 25 functions are orthonormal on the sphere, which fixes every constant in them."""
    directions, weights = sphere_quadrature()
    values = evaluate(directions, 4)
    gram = (values * weights[:, None]).T @ values
    assert np.abs(gram - np.eye(25)).max() < 1e-14


def test_order_and_signs_are_those_of_3dgs() -> None:
    """Band 1 is (-y, z, -x); bands 2 and 3 start with xy and end as 3DGS orders them."""
    x, y, z = 0.48, -0.6, 0.64
    value = evaluate(np.array([[x, y, z]]), 3)[0]
    assert np.allclose(value[1:4], 0.4886025119029199 * np.array([-y, z, -x]), rtol=1e-14)
    assert np.allclose(value[[4, 5, 7]], 1.0925484305920792 * np.array([x * y, -y * z, -x * z]), rtol=1e-14)
    assert np.isclose(value[8], 0.5462742152960396 * (x * x - y * y), rtol=1e-14)
    assert np.isclose(value[10], 2.890611442640554 * x * y * z, rtol=1e-14)
    assert np.isclose(value[15], -0.5900435899266435 * x * (x * x - 3 * y * y), rtol=1e-14)


def test_degree_4_is_that_of_gsplat() -> None:
    """Values of band 4 as gsplat 1.5.3's torch reference has them, in order and sign."""
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    directions, _ = sphere_quadrature()
    found = evaluate(directions, 4)
    expected = reference._eval_sh_bases_fast(25, torch.from_numpy(directions))
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_bands_above_the_degree_are_zero(degree: int) -> None:
    """A lower degree evaluates the same functions and leaves the rest zero."""
    directions, _ = sphere_quadrature()
    full, some = evaluate(directions, 4), evaluate(directions, degree)
    active = (degree + 1) ** 2
    assert (some[:, :active] == full[:, :active]).all()
    assert (some[:, active:] == 0).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_adjoint_equals_finite_differences(degree: int) -> None:
    """The gradient of every basis function with respect to the direction."""
    directions, _ = sphere_quadrature()
    v = np.random.default_rng(0).normal(size=(len(directions), 25))
    found = wp.zeros(len(directions), dtype=VEC3, device="cpu")
    arrays = [wp.array(directions, dtype=VEC3, device="cpu"), wp.array(v, dtype=VALUES, device="cpu")]
    wp.launch(adjoint_kernel, dim=len(directions), inputs=[degree, *arrays, found], device="cpu")
    step = 1e-6
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        difference = (evaluate(directions + shift, degree) - evaluate(directions - shift, degree)) / (2 * step)
        assert np.abs(found.numpy()[:, axis] - (difference * v).sum(-1)).max() < 1e-8


@wp.kernel(module="unique", enable_backward=False)
def few_kernel(
    degree: int,
    directions: wp.array(dtype=VEC3),
    v: wp.array(dtype=FEW_VALUES),
    values: wp.array(dtype=FEW_VALUES),
    v_directions: wp.array(dtype=VEC3),
):
    """Values and gradients of the functions with room for degree 3."""
    i = wp.tid()
    values[i] = FEW_BASIS(directions[i], degree)
    v_directions[i] = FEW_ADJOINT(directions[i], degree, v[i])


@pytest.mark.parametrize("degree", [0, 3])
def test_functions_without_room_for_degree_4_are_the_same_to_the_bit(degree: int) -> None:
    """Kernels of lower degrees have smaller vectors and the same numbers."""
    directions, _ = sphere_quadrature()
    count = len(directions)
    v = np.pad(np.random.default_rng(1).normal(size=(count, 16)), ((0, 0), (0, 9)))
    values, few = wp.zeros(count, dtype=FEW_VALUES, device="cpu"), wp.zeros(count, dtype=VEC3, device="cpu")
    inputs = [wp.array(directions, dtype=VEC3, device="cpu"), wp.array(v[:, :16], dtype=FEW_VALUES, device="cpu")]
    wp.launch(few_kernel, dim=count, inputs=[degree, *inputs, values, few], device="cpu")
    full = wp.zeros(count, dtype=VEC3, device="cpu")
    inputs[1] = wp.array(v, dtype=VALUES, device="cpu")
    wp.launch(adjoint_kernel, dim=count, inputs=[degree, *inputs, full], device="cpu")
    assert (values.numpy() == evaluate(directions, degree)[:, :16]).all()
    assert (few.numpy() == full.numpy()).all()
