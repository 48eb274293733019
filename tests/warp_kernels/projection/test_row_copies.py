"""Rows are gathered and put back as torch indexes them."""

import pytest
import torch
import warp as wp

from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.projection.row_copies import gather_rows, scatter_rows


def as_array(table: torch.Tensor) -> wp.array:
    """The tensor as the kernels take it."""
    return view(table, kinds_of(table.dtype).scalar, *table.shape)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("total", "width"), [(9, 1), (9, 3), (5000, 8), (0, 3)])
def test_rows_as_torch_indexes_them(device: torch.device, total: int, width: int, dtype: torch.dtype) -> None:
    """A number behind the last row gives zeros, and is left out on the way back."""
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(total, width, generator=generator).to(device, dtype)
    kept = torch.randperm(total, generator=generator)[: total // 2]
    numbers = torch.cat([kept, torch.tensor([total, total])]).to(device)
    padded = torch.cat([table, table.new_zeros(1, width)])
    rows = torch.full((len(numbers), width), torch.nan, dtype=dtype, device=device)
    back = torch.full_like(table, -1.0)
    with launches_on_torch_stream(device):
        gather_rows(view(numbers, wp.int64), as_array(table), as_array(rows))
        scatter_rows(view(numbers, wp.int64), as_array(rows), as_array(back))
    assert torch.equal(rows, padded[numbers])
    expected = torch.full_like(table, -1.0)
    expected[kept.to(device)] = table[kept.to(device)]
    assert torch.equal(back, expected)
