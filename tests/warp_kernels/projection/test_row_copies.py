"""Rows are gathered and placed as torch does it."""

import pytest
import torch
import warp as wp

from thermosplat.torch_bridge.arrays import strided_view, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.projection.row_copies import gather_rows, place_rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("total", "width"), [(9, 1), (9, 3), (5000, 8), (0, 3)])
@pytest.mark.parametrize("spare", [0, 1])
def test_rows_as_torch_indexes_them(
    device: torch.device, total: int, width: int, spare: int, dtype: torch.dtype
) -> None:
    """Of the first columns of a wider table too; a negative number gives zeros."""
    generator = torch.Generator().manual_seed(0)
    table = torch.randn(total, width + spare, generator=generator).to(device, dtype)[:, :width]
    kept = torch.randperm(total, generator=generator)[: total // 2]
    numbers = torch.cat([kept, torch.tensor([-1, -1])]).to(device, torch.int32)
    padded = torch.cat([table, table.new_zeros(1, width)])  # whose last row is number -1
    rows = torch.full((len(numbers), width), torch.nan, dtype=dtype, device=device)
    with launches_on_torch_stream(device):
        gather_rows(view(numbers, wp.int32), strided_view(table), strided_view(rows))
    assert torch.equal(rows, padded[numbers.long()])


@pytest.mark.parametrize(("cameras", "gaussians", "room"), [(1, 7, 3), (3, 1000, 400), (2, 50, 80), (2, 0, 4)])
def test_wanted_rows_are_numbered_from_the_first_on(
    device: torch.device, cameras: int, gaussians: int, room: int
) -> None:
    """Camera by camera; those that find no room, and those that nobody wants, have no place."""
    generator = torch.Generator().manual_seed(1)
    wanted = (torch.rand(cameras, gaussians, generator=generator) < 0.5).to(device)
    until = wanted.flatten().cumsum(0, dtype=torch.int32)
    numbers = until.new_full((cameras * room,), -1)
    places = torch.empty_like(until)
    with launches_on_torch_stream(device):
        place_rows(view(until, wp.int32), gaussians, room, view(numbers, wp.int32), view(places, wp.int32))
    for camera in range(cameras):
        expected = wanted[camera].nonzero().squeeze(1)[:room]
        of_camera = numbers[camera * room : (camera + 1) * room]
        assert torch.equal(of_camera[: len(expected)], (expected + camera * gaussians).int())
        assert (of_camera[len(expected) :] == -1).all()
        found = places.view(cameras, gaussians)[camera]
        assert torch.equal(found[expected], torch.arange(len(expected), device=device).int())
        assert int((found >= 0).sum()) == len(expected)
