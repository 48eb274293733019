"""Rows of tensors in the host's memory, laid out so that what a kernel takes of them crosses the bus in whole lines.

A bus carries most where each request is of whole, aligned lines: 64 bytes on the host's side, up to 128 on the device's
(EMOGI, Min et al. 2020, arXiv 2006.06890). A row of 45 numbers is 180 bytes, and would begin and end within lines. So
rows are padded to a multiple of ``LINE`` numbers. Two tensors that are always read together, such as Adam's moments,
lie in one buffer [N, L, 2], number beside number. Torch sees views of such buffers, of the shapes and with the numbers
of ordinary tensors.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from thermosplat.torch_bridge.host_memory import host_empty, is_in_host_memory

LINE = 8
"""Rows are multiples of so many numbers; rows of two tensors are then multiples of 64 bytes, the host's cache line."""
COPIED_AT_ONCE = 2**20
"""Rows that are brought to or from the CPU's tensors at once: torch copies views by way of the device's memory."""


class Pair(NamedTuple):
    """Two tensors [N, ...] of one shape that lie in one buffer."""

    first: Tensor
    second: Tensor

    @property
    def buffer(self) -> Tensor:
        """The buffer, [N, 2 L]: the numbers of both by turns, then zeros."""
        width = 2 * row_length(self.first)
        return self.first.as_strided((len(self.first), width), (width, 1))


def row_length(values: Tensor) -> int:
    """L, numbers that a row of values [N, ...] takes in the host's memory."""
    return -(-math.prod(values.shape[1:]) // LINE) * LINE


def host_rows(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """A float32 tensor in the host's memory whose rows are padded, not initialised.

    Args:
        shape: Its extents, [N, ...].
    """
    length = math.prod(shape[1:])
    return _view(host_empty((shape[0], -(-length // LINE) * LINE), device), shape, 1)


def row_buffer(values: Tensor) -> Tensor:
    """The buffer of a tensor that ``host_rows`` made, [N, L]; of another one without gaps its rows, [N, K].

    Args:
        values: Of any shape [N, ...].
    """
    if not has_padded_rows(values):
        return values.view(len(values), math.prod(values.shape[1:]))
    length = row_length(values)
    return values.as_strided((len(values), length), (length, 1))


def has_padded_rows(values: Tensor) -> bool:
    """Whether a tensor's rows lie as ``host_rows`` lays them, in the host's memory."""
    return is_in_host_memory(values) and values.stride() == _strides(values.shape, 1)


def in_host_rows(values: Tensor, device: torch.device | str) -> Tensor:
    """A tensor for a device's kernels whose rows are padded and lie in the host's memory.

    Args:
        values: float32, anywhere.

    Returns:
        The tensor itself where it is one; else a copy.
    """
    device = _indexed(device)
    if values.device == device and has_padded_rows(values):
        return values
    made = host_rows(tuple(values.shape), device)
    copy_rows(made, values)
    return made


def zero_pair(shape: tuple[int, ...], device: torch.device) -> Pair:
    """Two tensors of zeros in the host's memory that lie in one buffer.

    Args:
        shape: Of each, [N, ...].
    """
    pair = _empty_pair(shape, device)
    pair.buffer.zero_()
    return pair


def paired(first: Tensor, second: Tensor, device: torch.device | str) -> Pair:
    """Two tensors of one shape as a pair in the host's memory.

    Args:
        first: float32, anywhere.

    Returns:
        These tensors where they are a pair; else copies.
    """
    device, strides = _indexed(device), _strides(first.shape, 2)
    beside = second.data_ptr() == first.data_ptr() + first.element_size()
    if beside and first.device == device and is_in_host_memory(first) and first.stride() == strides == second.stride():
        return Pair(first, second)
    made = zero_pair(tuple(first.shape), device)
    copy_rows(made.first, first)
    copy_rows(made.second, second)
    return made


def selected_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Rows of a tensor that ``host_rows`` made, as another one.

    Args:
        values: [N, ...].
        rows: int64, [n].
    """
    made = host_rows((len(rows), *values.shape[1:]), values.device)
    torch.index_select(row_buffer(values), 0, rows, out=row_buffer(made))
    return made


def selected_pair(pair: Pair, rows: Tensor) -> Pair:
    """Rows of a pair, as another one.

    Args:
        pair: Of [N, ...].
        rows: int64, [n].
    """
    made = _empty_pair((len(rows), *pair.first.shape[1:]), pair.first.device)
    torch.index_select(pair.buffer, 0, rows, out=made.buffer)
    return made


@torch.no_grad()
def copy_rows(target: Tensor, source: Tensor) -> None:
    """Copy a tensor in parts, so that it takes little of the device's memory.

    Args:
        target: [N, ...], anywhere.
        source: Of the same shape, anywhere.
    """
    for first in range(0, len(source), COPIED_AT_ONCE):
        part = slice(first, first + COPIED_AT_ONCE)
        target[part].copy_(source[part])


def on_cpu(values: Tensor) -> Tensor:
    """A copy of a tensor as an ordinary one of the CPU.

    Args:
        values: float32, [N, ...].
    """
    copied = torch.empty(values.shape)
    copy_rows(copied, values.detach())
    return copied


def _empty_pair(shape: tuple[int, ...], device: torch.device) -> Pair:
    length = -(-math.prod(shape[1:]) // LINE) * LINE
    buffer = host_empty((shape[0], 2 * length), device)
    return Pair(_view(buffer, shape, 2), _view(buffer, shape, 2, 1))


def _view(buffer: Tensor, shape: tuple[int, ...], step: int, offset: int = 0) -> Tensor:
    """Each ``step``-th number of the buffer's rows from ``offset`` on, as rows of a shape."""
    return buffer.as_strided(shape, _strides(shape, step), buffer.storage_offset() + offset)


def _strides(shape: tuple[int, ...], step: int) -> tuple[int, ...]:
    """Strides of a tensor of that shape in a buffer of padded rows, of which it has each ``step``-th number."""
    strides = [step]
    for extent in reversed(shape[2:]):
        strides.append(strides[-1] * extent)
    length = -(-math.prod(shape[1:]) // LINE) * LINE
    return (step * length, *reversed(strides[: len(shape) - 1]))


def _indexed(device: torch.device | str) -> torch.device:
    """A device with its number."""
    device = torch.device(device)
    return torch.device("cuda", torch.cuda.current_device()) if device == torch.device("cuda") else device
