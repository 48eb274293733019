"""Tensors of a device in the host's memory: torch and kernels use them as any other."""

import gc
import weakref
from typing import Any

import pytest
import torch
import warp as wp

from thermosplat.torch_bridge.host_memory import host_empty, is_in_host_memory


def test_a_tensor_of_the_device(device: torch.device) -> None:
    """Shape, device, and what is written to it; of the CPU's it is an ordinary one."""
    values = torch.arange(60.0).reshape(5, 4, 3)
    held = host_empty((5, 4, 3), device).copy_(values)
    assert held.device.type == device.type
    assert held.shape == (5, 4, 3)
    assert is_in_host_memory(held)
    held[2] = -1.0
    rows = torch.index_select(held, 0, torch.tensor([2, 4], device=device))
    assert rows.cpu().flatten().tolist() == [-1.0] * 12 + list(range(48, 60))
    assert torch.equal(held.cpu()[4], values[4])
    host_empty((0, 3), device)


@pytest.mark.cuda
def test_takes_nothing_of_the_device() -> None:
    """64 MiB of it leave torch's memory as it is, and CUDA knows them as the host's; a copy of it does not."""
    device = torch.device("cuda")
    host_empty((1, 1), device)
    before = torch.cuda.memory_allocated()
    held = host_empty((2**24,), device).zero_()
    assert torch.cuda.memory_allocated() == before
    assert not is_in_host_memory(held.clone())
    selected = torch.index_select(torch.ones(2**24, device=device), 0, torch.arange(2**24, device=device), out=held)
    assert selected.data_ptr() == held.data_ptr()
    assert held.sum().item() == 2**24


@pytest.mark.cuda
def test_blocks_are_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tensor a little larger than one that is gone takes its memory; one that is much larger does not."""
    device, make = torch.device("cuda"), wp.empty
    blocks: weakref.WeakSet[wp.array] = weakref.WeakSet()

    def noted(*arguments: Any, **named: Any) -> wp.array:
        block = make(*arguments, **named)
        blocks.add(block)
        return block

    monkeypatch.setattr(wp, "empty", noted)
    first = host_empty((2**22,), device)
    address = first.data_ptr()
    del first
    gc.collect()
    assert host_empty((2**22 + 1000,), device).data_ptr() == address
    gc.collect()
    large = host_empty((2**25,), device)
    gc.collect()
    assert [block.ptr for block in blocks] == [large.data_ptr()]  # what is too small is not kept
    assert float(large.fill_(1.0).sum()) == 2**25
