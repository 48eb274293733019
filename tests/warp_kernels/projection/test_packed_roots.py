"""Remainders of positions in the bits of one float."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.projection.packed_roots import MOST, STEP, packed_root_functions

PACK, UNPACK, ROW = packed_root_functions(wp.float32)
PACK_64, UNPACK_64, _ = packed_root_functions(wp.float64)


@wp.kernel(enable_backward=False, module="unique")
def there_and_back_kernel(
    remainders: wp.array(dtype=wp.vec2), rows: wp.array(dtype=wp.vec4), back: wp.array(dtype=wp.vec2)
):
    """Packs each remainder behind a root of (1, 2, 3), and unpacks it from the row."""
    i = wp.tid()
    rows[i] = wp.vec4(1.0, 2.0, 3.0, PACK(remainders[i]))
    back[i] = UNPACK(ROW(rows, i)[3])


@wp.kernel(enable_backward=False, module="unique")
def nothing_kernel(remainders: wp.array(dtype=wp.vec2d), back: wp.array(dtype=wp.vec2d)):
    """Packs and unpacks in float64."""
    i = wp.tid()
    back[i] = UNPACK_64(PACK_64(remainders[i]))


def there_and_back(remainders: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    """The rows [n, 4] and what comes back of the remainders [n, 2]."""
    rows = wp.zeros(len(remainders), dtype=wp.vec4, device=device)
    back = wp.zeros(len(remainders), dtype=wp.vec2, device=device)
    given = wp.array(remainders.astype(np.float32), dtype=wp.vec2, device=device)
    wp.launch(there_and_back_kernel, len(remainders), [given, rows, back], device=device)
    return rows.numpy(), back.numpy()


@pytest.mark.parametrize("pixels", [1.0, 40.0, 1080.0, 8191.0])
def test_what_rounding_takes_comes_back(pixels: float, device: torch.device) -> None:
    """To half a step in either direction, which is what is left of the position's error."""
    exact = np.random.default_rng(0).uniform(-pixels, pixels, (4000, 2))
    remainders = exact - exact.astype(np.float32)
    rows, back = there_and_back(remainders, str(device))
    assert (rows[:, :3] == [1.0, 2.0, 3.0]).all()
    assert np.abs(back - remainders).max() <= 0.51 * STEP
    assert np.isfinite(rows).all()


def test_every_whole_number_of_steps_is_a_finite_float(device: torch.device) -> None:
    """No bits are those of infinity or of a NaN, which could be changed on the way; the last 128 steps become one."""
    steps = np.arange(-MOST - 5, MOST + 6)
    remainders = STEP * np.stack([steps, steps[::-1]], -1)
    rows, back = there_and_back(remainders, str(device))
    assert np.isfinite(rows).all()
    expected = np.clip(remainders, -MOST * STEP, MOST * STEP)
    assert np.array_equal(back[:, 1], expected[:, 1].astype(np.float32))
    assert np.abs(back[:, 0] - expected[:, 0]).max() <= 129 * STEP
    assert np.array_equal(back[:-150, 0], expected[:-150, 0].astype(np.float32))


def test_float64_needs_none() -> None:
    """Its positions are exact enough."""
    remainders = wp.array(np.full((3, 2), 1e-4), dtype=wp.vec2d, device="cpu")
    back = wp.zeros(3, dtype=wp.vec2d, device="cpu")
    wp.launch(nothing_kernel, 3, [remainders, back], device="cpu")
    assert (back.numpy() == 0).all()
