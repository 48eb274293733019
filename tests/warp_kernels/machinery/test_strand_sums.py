"""Sums of records per image."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.machinery.strand_sums import STRANDS, strand_sums


@pytest.mark.parametrize("num_gaussians", [0, 1, STRANDS - 1, STRANDS, 3 * STRANDS + 5])
def test_strands_sum_to_the_total(num_gaussians: int) -> None:
    """Three images of float32 records, summed in float64."""
    records = np.random.default_rng(0).normal(size=(3, num_gaussians, 5)).astype(np.float32)
    array = wp.array(records.reshape(-1, 5), dtype=wp.types.vector(5, wp.float32), device="cpu")
    sums = strand_sums(array, 3).numpy().reshape(3, STRANDS, 5)
    assert np.allclose(sums.sum(1), records.astype(np.float64).sum(1), rtol=0, atol=1e-11)


def test_sums_do_not_lose_small_terms() -> None:
    """A float32 sum of these would drop the small ones."""
    records = np.full((200_000, 1), 1e-4, np.float32)
    records[0] = 1e4
    array = wp.array(records, dtype=wp.types.vector(1, wp.float32), device="cpu")
    assert strand_sums(array, 1).numpy().sum() == pytest.approx(1e4 + 199_999 * float(np.float32(1e-4)), rel=1e-12)
