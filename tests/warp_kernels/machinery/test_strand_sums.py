"""Sums of records per image."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.machinery.strand_sums import STRANDS, image_sums


def summed(records: np.ndarray, device: torch.device, dtype: type = wp.float32) -> np.ndarray:
    """``image_sums`` of records [images, N, length]."""
    images, _, length = records.shape
    array = wp.array(records.reshape(-1, length), dtype=wp.types.vector(length, dtype), device=str(device))
    return image_sums(array, images).numpy().reshape(images, length)


@pytest.mark.parametrize("num_records", [0, 1, 31, 33, STRANDS - 1, STRANDS, 3 * STRANDS + 5, 5000])
@pytest.mark.parametrize("length", [1, 5, 54])
def test_each_image_has_its_total(device: torch.device, num_records: int, length: int) -> None:
    """Three images of float32 records, summed in float64; the same on every run."""
    records = np.random.default_rng(0).normal(size=(3, num_records, length)).astype(np.float32)
    found = summed(records, device)
    assert np.allclose(found, records.astype(np.float64).sum(1), rtol=0, atol=1e-11)
    assert np.array_equal(found, summed(records, device))


def test_records_in_double_precision(device: torch.device) -> None:
    """Are not rounded."""
    records = np.random.default_rng(1).normal(size=(2, 700, 16))
    assert np.allclose(summed(records, device, wp.float64), records.sum(1), rtol=0, atol=1e-12)


def test_sums_do_not_lose_small_terms(device: torch.device) -> None:
    """A float32 sum of these would drop the small ones."""
    records = np.full((1, 200_000, 1), 1e-4, np.float32)
    records[0, 0] = 1e4
    assert summed(records, device).item() == pytest.approx(1e4 + 199_999 * float(np.float32(1e-4)), rel=1e-12)
