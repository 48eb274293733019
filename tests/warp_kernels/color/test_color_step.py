"""The colours' step: where it takes the cameras to be, and that storing gradients is adding them to zeros."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.color.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint

N, IMAGES, K = 23, 2, 16
VEC3 = wp.types.vector(3, wp.float64)


def color_arrays(per_image: bool, requires_grad: bool = True) -> tuple[ColorArrays, ColorSettings, np.ndarray]:
    """Random coefficients of degree 2 of 3 that are given, some Gaussians culled, and cameras that are not rigid."""
    rng = np.random.default_rng(1)
    rows = IMAGES * N if per_image else N

    def array(values: np.ndarray, kind: type) -> wp.array:
        return wp.array(values, dtype=kind, device="cpu", requires_grad=requires_grad)

    viewmats = np.eye(4) + 0.3 * rng.normal(size=(IMAGES, 4, 4))
    arrays = ColorArrays(
        means=array(rng.normal(size=(N, 3)), VEC3),
        viewmats=array(viewmats, wp.mat44d),
        sh0=array(rng.normal(size=(rows, 1, 3)), VEC3),
        shN=array(rng.normal(size=(rows, K - 1, 3)), VEC3),
        visible=wp.array(rng.integers(0, 2, IMAGES * N) > 0, dtype=wp.bool, device="cpu"),
        colors=array(np.zeros((IMAGES * N, 3)), VEC3),
    )
    return arrays, ColorSettings(2, N, IMAGES, per_image), viewmats


def test_cameras_are_where_their_matrices_say() -> None:
    """The last column of the inverse, and autograd's gradient through it, for matrices of any kind."""
    arrays, settings, viewmats = color_arrays(False)
    tape = wp.Tape()
    sh_colors(arrays, settings, tape)
    matrices = torch.from_numpy(viewmats).requires_grad_()
    positions = torch.linalg.inv(matrices)[:, :3, 3]
    assert np.abs(arrays.camera_positions.numpy() - positions.detach().numpy()).max() < 1e-12

    rng = np.random.default_rng(2)
    arrays.colors.grad.assign(rng.normal(size=(IMAGES * N, 3)))
    tape.backward()
    # The colour depends on mean - position, so that in each image the means' gradients are minus the position's.
    v_positions = []
    for image in range(IMAGES):
        alone, _, _ = color_arrays(False)
        sh_colors(alone, settings)
        gradient = arrays.colors.grad.numpy().reshape(IMAGES, N, 3) * (np.arange(IMAGES) == image)[:, None, None]
        alone.colors.grad.assign(gradient.reshape(-1, 3))
        sh_colors_adjoint(alone, settings)
        v_positions.append(-alone.means.grad.numpy().sum(0))
    (expected,) = torch.autograd.grad(positions, matrices, torch.from_numpy(np.stack(v_positions)))
    found = arrays.viewmats.grad.numpy()
    assert np.linalg.norm(found) > 0
    assert np.abs(found - expected.numpy()).max() < 1e-11 * np.abs(found).max()


@pytest.mark.parametrize("per_image", [False, True])
def test_stored_gradients_are_the_added_ones(per_image: bool) -> None:
    """Memory that holds anything is overwritten, culled Gaussians and degrees that are not in use included."""
    gradients = []
    for store in (False, True):
        arrays, settings, _ = color_arrays(per_image)
        sh_colors(arrays, settings)
        arrays.colors.grad.assign(np.random.default_rng(2).normal(size=(IMAGES * N, 3)))
        found = [arrays.means.grad, arrays.sh0.grad, arrays.shN.grad]
        if store:
            for gradient in found:
                gradient.fill_(np.nan)
        sh_colors_adjoint(arrays, settings, store=store)
        gradients.append([gradient.numpy() for gradient in found])
    assert all(np.array_equal(one, other) for one, other in zip(*gradients, strict=True))
    assert np.linalg.norm(gradients[0][2]) > 0
