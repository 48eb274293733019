"""Tensors of a CUDA device that lie in the host's memory: kernels read and write them over the bus.

Memory that CUDA has pinned has one address for the host and for all devices (unified virtual addressing), so a pointer
to it is as good as one to the device's own memory. Torch takes such a pointer as a CUDA tensor, and every operation on
that tensor works; only what an operation returns lies on the device again.

Pinning takes about a second for some gigabytes, so blocks that nobody needs any more are kept for the next tensor. They
are used by kernels alone, on the stream that used them before.
"""

import math

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.kernel_cache import start_warp

_SPARE = 1.125
"""A new block is larger than asked for by this factor, so that it serves when there are some more Gaussians."""
_LARGEST = 1.5
"""A kept block serves if it is not larger than this multiple of what is asked for."""
_ROW = 2**20
"""Blocks are counted in so many bytes, since an extent of a Warp array has 32 bits."""


_kept: dict[int, wp.array] = {}
"""Pinned memory that nobody uses now, by its address."""
_in_use: set[int] = set()
"""Addresses of the blocks that tensors lie in."""


class _Borrowed:
    """A block as torch takes it; kept for others when the last tensor on it is gone."""

    def __init__(self, block: wp.array, shape: tuple[int, ...]) -> None:
        self._block, self._address = block, int(block.ptr)
        self.__cuda_array_interface__ = {
            "shape": shape,
            "typestr": "<f4",
            "data": (self._address, False),
            "strides": None,
            "version": 3,
        }
        _in_use.add(self._address)

    def __del__(self, in_use: set[int] = _in_use, kept: dict[int, wp.array] = _kept) -> None:
        in_use.discard(self._address)
        kept[self._address] = self._block


def _block(rows: int) -> wp.array:
    """A block of at least so many times ``_ROW`` bytes."""
    fitting = [block for block in list(_kept.values()) if rows <= block.shape[0] <= max(_LARGEST * rows, rows + 1)]
    for block in sorted(fitting, key=lambda block: block.shape[0]):
        if _kept.pop(int(block.ptr), None) is not None:
            return block
    # Gaussians grow or shrink as a whole: what is too small or too large now will hardly serve later
    torch.cuda.synchronize()
    _kept.clear()
    return wp.empty((math.ceil(_SPARE * rows), _ROW), dtype=wp.uint8, device="cpu", pinned=True)


def host_empty(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """A float32 tensor in the host's memory that a device's kernels use, not initialised.

    Args:
        device: Of a CUDA device: the tensor says it is there. The CPU: an ordinary tensor.

    Raises:
        RuntimeError: The host has no memory left to pin, or torch does not take it.
    """
    if device.type != "cuda" or math.prod(shape) == 0:
        return torch.empty(shape, device=device)
    start_warp()
    with torch.cuda.device(device):
        block = _block(-(-4 * math.prod(shape) // _ROW))
        tensor: Tensor = torch.as_tensor(_Borrowed(block, shape), device=device)
    if tensor.data_ptr() != int(block.ptr):
        raise RuntimeError(f"torch {torch.__version__} copied pinned memory instead of taking it as a tensor.")
    return tensor


def is_in_host_memory(tensor: Tensor) -> bool:
    """Whether a tensor's numbers lie in the host's memory, from the first on of one that ``host_empty`` made."""
    return not tensor.is_cuda or tensor.numel() == 0 or tensor.data_ptr() in _in_use
