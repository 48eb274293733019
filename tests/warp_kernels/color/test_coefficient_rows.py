"""Rows of coefficients that a warp moves together: the same products as plain sums, wherever the rows lie."""

import functools

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.color.coefficient_rows import row_adjoint_function
from warp_kernels.machinery.lanes import whole_warps

ROWS = 77
"""Not a multiple of a warp."""


@functools.cache
def adjoint_kernel(dtype: type, most: int) -> wp.Kernel:
    """A kernel that calls the function, one thread per row."""
    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(most, dtype)
    row_adjoint = row_adjoint_function(dtype, most)

    @wp.kernel(name=f"adjoint_products_{dtype.__name__}_{most}", module="unique", enable_backward=False)
    def adjoint(
        order: wp.array(dtype=int),
        used: wp.array(dtype=int),
        rows: wp.array2d(dtype=vec3),
        b: wp.array(dtype=vecK),
        v: wp.array(dtype=vec3),
        lowest: int,
        active: int,
        add: bool,
        # outputs
        v_rows: wp.array2d(dtype=vec3),
        v_b: wp.array(dtype=vecK),
    ):
        thread = wp.tid()
        row = -1
        needed = False
        weights = vecK()
        gradient = vec3()
        if thread < order.shape[0]:
            row = order[thread]
            needed = used[row] != 0
            weights = b[row]
            gradient = v[row]
        dots = row_adjoint(rows, v_rows, lowest, row, weights, gradient, active, needed, add)
        if row >= 0:
            v_b[row] = dots

    return adjoint


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize(
    ("count", "active", "most"),
    [
        *((15, 16, 16), (15, 9, 16), (8, 9, 16), (16, 16, 16), (3, 1, 16), (6, 4, 16), (10, 9, 16), (24, 16, 16)),
        *((24, 25, 25), (25, 25, 25), (26, 25, 25), (30, 25, 25)),
    ],
)
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("lowest", [0, 1])
def test_products_are_plain_sums(
    device: torch.device, dtype: type, shuffled: bool, count: int, active: int, most: int, gaps: bool, lowest: int
) -> None:
    """Rows side by side, out of order or with gaps, with degree 0 or without; some in use, the others unread."""
    rng = np.random.default_rng(count + active)
    rows, before = rng.normal(size=(2, ROWS, count, 3))
    b, v = rng.normal(size=(ROWS, most)), rng.normal(size=(ROWS, 3))
    used = rng.random(ROWS) < 0.7
    used[32:64] = False  # a whole warp
    used[64:-1] = False  # all but one of another
    used[-1] = True
    rows[~used] = np.nan
    order = rng.permutation(ROWS) if shuffled else np.arange(ROWS)
    adjoint = adjoint_kernel(dtype, most)
    where = wp.get_device(str(device))

    def array(values: np.ndarray, kind: object) -> wp.array:
        return wp.array(values, dtype=kind, device=where)

    def spread(values: np.ndarray) -> wp.array:
        """Rows in memory, with a gap after each where gaps are asked for."""
        padded = np.concatenate([values, np.zeros((ROWS, 2, 3))], 1) if gaps else values
        return array(padded, wp.types.vector(3, dtype))[:, :count]

    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(most, dtype)
    shared = [array(order, int), array(used.astype(int), int), spread(rows), array(b, vecK)]
    threads = whole_warps(ROWS, where)
    weights = np.where(np.arange(lowest, count + lowest) < min(active, most), 1.0, 0.0)
    kept = np.where(used[:, None, None], np.nan_to_num(rows), 0.0) * weights[:, None]
    padded_b = np.pad(b, ((0, 0), (0, count)))[:, lowest : count + lowest]
    tolerance = 1e-12 if dtype is wp.float64 else 2e-5

    outer = np.where(used[:, None, None], padded_b[..., None] * v[:, None], 0.0) * weights[:, None]
    for add in (True, False):
        v_rows, v_b = spread(before if add else np.full_like(before, np.nan)), wp.zeros(ROWS, vecK, device=where)
        inputs = [*shared, array(v, vec3), lowest, active, add, v_rows, v_b]
        wp.launch(adjoint, dim=threads, inputs=inputs, device=where, block_dim=256)
        np.testing.assert_allclose(v_rows.numpy(), before + outer if add else outer, atol=tolerance)
        dots = np.einsum("nkc,nc->nk", kept, v)[:, 1 - lowest :][:, : most - 1]  # that of degree 0 is left out
        np.testing.assert_allclose(v_b.numpy()[:, 1 : 1 + dots.shape[1]], dots, atol=tolerance)
