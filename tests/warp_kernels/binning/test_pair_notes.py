"""How many pairs a rasterization had, and whether they had room."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning.pair_notes import UNLIMITED, note_pairs


@pytest.mark.parametrize(
    ("totals", "limits", "overflow"),
    [
        ([70], (70, 0), 0.0),
        ([71], (70, 0), 1.0),
        ([70, 9], (70, 9), 0.0),
        ([70, 10], (70, 9), 1.0),
        ([10**12, 10**12], (UNLIMITED, UNLIMITED), 0.0),
        ([], (0, 0), 0.0),
    ],
)
def test_totals_are_noted(totals: list[int], limits: tuple[int, int], overflow: float) -> None:
    """The most of a call is kept, other calls are left alone, and what is above a limit is told."""
    most = [wp.array([5, 50, 5], dtype=wp.int64, device="cpu") for _ in range(2)]
    flag = wp.zeros(1, dtype=wp.float32, device="cpu")
    note_pairs(1, limits, wp.array(np.array(totals, dtype=np.int64), dtype=wp.int64, device="cpu"), *most, flag)
    for array, total in zip(most, [*totals, 0, 0], strict=False):
        assert array.numpy().tolist() == [5, max(50, total), 5]
    assert flag.numpy()[0] == overflow


def test_a_step_that_overflowed_stays_so() -> None:
    """A later call that has room does not take the note back."""
    most, flag = wp.zeros(2, dtype=wp.int64, device="cpu"), wp.zeros(1, dtype=wp.float32, device="cpu")
    for call, count in ((0, 9), (1, 1)):
        note_pairs(call, (8, 8), wp.array([count], dtype=wp.int64, device="cpu"), most, most, flag)
    assert flag.numpy()[0] == 1.0
