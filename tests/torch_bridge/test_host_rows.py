"""Padded rows and pairs in the host's memory: views with the numbers of ordinary tensors."""

import math

import pytest
import torch
from torch import Tensor

from thermosplat.torch_bridge import host_rows as subject
from thermosplat.torch_bridge.host_memory import is_in_host_memory
from thermosplat.torch_bridge.host_rows import (
    copy_rows,
    has_padded_rows,
    host_rows,
    in_host_rows,
    on_cpu,
    paired,
    row_buffer,
    row_length,
    selected_pair,
    selected_rows,
    zero_pair,
)

SHAPES = [(5, 15, 3), (5, 8), (5, 24, 3), (5,), (0, 15, 3), (1, 3, 3)]


def numbers(shape: tuple[int, ...], start: float = 0.0) -> Tensor:
    """Numbers that differ."""
    return start + torch.arange(float(math.prod(shape))).reshape(shape)


@pytest.mark.parametrize("shape", SHAPES)
def test_rows_are_padded_to_lines(device: torch.device, shape: tuple[int, ...]) -> None:
    """Shape and numbers are the tensor's; rows begin at multiples of 32 bytes; what is padded stays as it is."""
    values = numbers(shape)
    held = in_host_rows(values, device)
    assert held.shape == values.shape
    assert torch.equal(held.cpu(), values)
    assert held.device.type == device.type
    assert has_padded_rows(held)
    assert in_host_rows(held, device) is held
    buffer = row_buffer(held)
    assert buffer.shape == (shape[0], row_length(values))
    assert buffer.stride(0) % 8 == 0
    assert buffer.is_contiguous()
    assert torch.equal(buffer[:, : math.prod(shape[1:])].cpu(), values.reshape(shape[0], math.prod(shape[1:])))


def test_other_tensors_are_their_rows(device: torch.device) -> None:
    """Of a tensor without padding the buffer is the tensor itself, row by row."""
    values = numbers((5, 15, 3)).to(device)
    assert not has_padded_rows(values)
    assert row_buffer(values).shape == (5, 45)
    assert row_buffer(values).data_ptr() == values.data_ptr()


@pytest.mark.parametrize("shape", SHAPES)
def test_pairs_lie_number_beside_number(device: torch.device, shape: tuple[int, ...]) -> None:
    """A buffer has the first's and the second's numbers by turns, then zeros; a pair is taken as it is."""
    first, second = numbers(shape), numbers(shape, 1000.0)
    pair = paired(first, second, device)
    assert torch.equal(pair.first.cpu(), first)
    assert torch.equal(pair.second.cpu(), second)
    length = math.prod(shape[1:])
    buffer = pair.buffer.cpu().reshape(shape[0], row_length(first), 2)
    assert torch.equal(buffer[:, :length, 0], first.reshape(shape[0], length))
    assert torch.equal(buffer[:, :length, 1], second.reshape(shape[0], length))
    assert not buffer[:, length:].any()
    again = paired(*pair, device)
    assert shape[0] == 0 or (again.first is pair.first and again.second is pair.second)
    swapped = paired(pair.second, pair.first, device)
    assert torch.equal(swapped.first.cpu(), second)
    assert torch.equal(swapped.second.cpu(), first)


def test_one_tensor_twice_is_no_pair(device: torch.device) -> None:
    """Moments that are equal are still two."""
    values = numbers((5, 8)).to(device)
    pair = paired(values, values, device)
    pair.first.zero_()
    assert torch.equal(pair.second, values)


@pytest.mark.parametrize("shape", SHAPES)
def test_rows_are_selected(device: torch.device, shape: tuple[int, ...]) -> None:
    """Repeated rows in any order, of a tensor and of a pair, laid out as those."""
    rows = torch.tensor([0, 0, shape[0] - 1][: 3 * min(shape[0], 1)], dtype=torch.int64, device=device)
    values, other = numbers(shape).to(device), numbers(shape, 50.0).to(device)
    found = selected_rows(in_host_rows(values, device), rows)
    assert has_padded_rows(found)
    assert torch.equal(found, values[rows])
    pair = selected_pair(paired(values, other, device), rows)
    assert torch.equal(pair.first, values[rows])
    assert torch.equal(pair.second, other[rows])
    assert len(rows) == 0 or paired(*pair, device).first is pair.first


def test_copies_in_parts(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """More rows than are copied at once come and go whole."""
    monkeypatch.setattr(subject, "COPIED_AT_ONCE", 3)
    values = numbers((10, 15, 3))
    held = host_rows((10, 15, 3), device)
    copy_rows(held, values)
    back = on_cpu(held.requires_grad_())
    assert torch.equal(back, values)
    assert back.is_contiguous()
    assert not back.requires_grad


def test_zeros(device: torch.device) -> None:
    """A pair begins with zeros, padding included."""
    pair = zero_pair((7, 15, 3), device)
    assert pair.buffer.shape == (7, 96)
    assert not pair.buffer.any()


@pytest.mark.cuda
def test_takes_nothing_of_the_device() -> None:
    """100 MB of rows and 200 MB of pairs leave torch's memory as it is; a part of it is used for a while."""
    device = torch.device("cuda")
    host_rows((1, 8), device)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    rows, pair = host_rows((2**19, 15, 3), device), zero_pair((2**19, 15, 3), device)
    assert torch.cuda.memory_allocated() == before
    assert is_in_host_memory(rows)
    assert is_in_host_memory(pair.first)
    on_cpu(pair.second)
    assert torch.cuda.memory_allocated() == before
