"""The tiles of an image, and the window they are blurred with."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.image_loss.image_tiles import RADIUS, WIDTH, buffers, tile_height, tiles_of, window


def test_window_is_a_gaussian() -> None:
    """Its taps sum to 1, are symmetric, and fall as a Gaussian does."""
    taps = window(1.5)
    assert len(taps) == 2 * RADIUS + 1
    assert sum(taps) == pytest.approx(1.0)
    assert taps == taps[::-1]
    assert taps[RADIUS + 3] / taps[RADIUS] == pytest.approx(np.exp(-2.0))


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_tiles_cover_the_image(dtype: type) -> None:
    """The last ones of a row or column may be cut."""
    rows = tile_height(dtype)
    assert tiles_of(rows, WIDTH, dtype) == 1
    assert tiles_of(rows + 1, WIDTH, dtype) == tiles_of(rows, WIDTH + 1, dtype) == 2
    assert tiles_of(3 * rows - 1, 2 * WIDTH - 1, dtype) == 6


def test_buffers_are_shared_on_cuda_alone() -> None:
    """On the CPU, where a block is one thread, they lie on its stack."""
    declared = buffers(2, 4, 1.5, wp.float32).split("#else")
    assert "__shared__ S_ held[2][" in declared[0]
    assert "__shared__" not in declared[1]
