"""Arrays as light as a kernel's argument, which keep a render's host time low.

Making a ``wp.array`` takes ten microseconds, and a render has fifty arrays. An ``ArrayView`` is the descriptor that
kernels read, packed once. The rest of the package takes either kind of array: a view has the attributes of ``wp.array``
that steps, sorts and scans use.
"""

import functools
import math
import struct
import threading
from typing import Any, NamedTuple

import warp as wp

# Warp's array_t: addresses of data and gradient, four extents, four strides [bytes], number of dimensions and flags.
_pack_address = struct.Struct("=Q").pack
_pack_layout = struct.Struct("=8x4i4iHH4x").pack


class _Layout(NamedTuple):
    """What arrays of one shape and type share."""

    strides: tuple[int, ...]  # [bytes]
    size: int
    is_contiguous: bool
    packed: bytes  # array_t after the data's address; gradients are arrays of their own here


@functools.lru_cache(maxsize=4096)
def _layout(shape: tuple[int, ...], dtype: Any, strides: tuple[int, ...] | None) -> _Layout:
    contiguous = contiguous_strides(shape, dtype)
    strides = contiguous if strides is None else strides
    if max((*shape, *map(abs, strides)), default=0) >= 2**31:
        raise ValueError(
            f"An array of shape {list(shape)} and strides {list(strides)} bytes is too large for a kernel: extents and "
            f"strides have 32 bits, so each must be at most {2**31 - 1:,}."
        )
    padding = (0,) * (4 - len(shape))
    packed = _pack_layout(*shape, *padding, *strides, *padding, len(shape), 0)
    return _Layout(strides, math.prod(shape), strides == contiguous, packed)


class ArrayView:
    """An array that kernels are launched on: an address with a shape and a type.

    Attributes:
        ptr: address.
        shape: extents.
        dtype: Warp type of an element.
        device: where the memory is.
        owner: what the memory belongs to, kept alive as long as the view; None: somebody else sees to that.
        grad: the gradient, an array of the same kind, or None.
        packed: the bytes a kernel reads.

    Raises:
        ValueError: if an extent or a stride needs more than 32 bits.
    """

    __slots__ = ("_layout", "device", "dtype", "grad", "owner", "packed", "ptr", "shape")

    def __init__(
        self,
        ptr: int,
        shape: tuple[int, ...],
        dtype: Any,
        device: wp.Device,
        owner: Any = None,
        strides: tuple[int, ...] | None = None,
    ) -> None:
        self.shape, self.dtype, self.device = shape, dtype, device
        self.owner, self.grad = owner, None
        self._layout = layout = _layout(shape, dtype, strides)
        self.ptr, self.packed = ptr, _pack_address(ptr) + layout.packed

    def place(self, ptr: int) -> None:
        """Puts the array elsewhere: to where its memory's content was moved."""
        self.ptr, self.packed = ptr, _pack_address(ptr) + self._layout.packed

    @property
    def strides(self) -> tuple[int, ...]:
        """Distances between elements [bytes]."""
        return self._layout.strides

    def gradient_at(self, ptr: int, owner: Any = None) -> None:
        """Gives the array a gradient of its own shape and type, whose elements follow one another."""
        self.grad = ArrayView(ptr, self.shape, self.dtype, self.device, owner)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, part: slice) -> "ArrayView":
        first, end, _ = part.indices(self.shape[0])
        shape = (end - first, *self.shape[1:])
        return ArrayView(self.ptr + first * self.strides[0], shape, self.dtype, self.device, self.owner, self.strides)

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of elements."""
        return self._layout.size

    @property
    def is_contiguous(self) -> bool:
        """Whether elements follow one another in memory."""
        return self._layout.is_contiguous

    def release(self) -> Any:
        """Stops keeping the memory alive.

        Returns:
            What it belongs to.
        """
        owner, self.owner = self.owner, None
        return owner

    def array(self) -> wp.array:
        """The same memory as Warp's own kind of array."""
        made = wp.array(
            ptr=self.ptr, dtype=self.dtype, shape=self.shape, strides=self.strides, device=self.device, copy=False
        )
        made._owner = self.owner
        return made

    def numpy(self) -> Any:
        """The numbers, copied to the host where they are not there."""
        return self.array().numpy()


def contiguous_strides(shape: tuple[int, ...], dtype: Any) -> tuple[int, ...]:
    """Strides of elements that follow one another."""
    stride = wp.types.type_size_in_bytes(dtype)
    strides = []
    for extent in reversed(shape):
        strides.append(stride)
        stride *= extent
    return tuple(reversed(strides))


def nothing(dtype: Any, ndim: int, device: wp.Device) -> ArrayView:
    """An array without elements, for one that there is not; always the same, so not to be given a gradient.

    Kernels take None for it; this is for code that asks an array for its shape or its gradient.
    """
    return _nothing(dtype, ndim, device.alias)


@functools.cache
def _nothing(dtype: Any, ndim: int, device: str) -> ArrayView:
    return ArrayView(0, (0,) * ndim, dtype, wp.get_device(device))


class WarpMemory:
    """Arrays of Warp's own, as steps make them for users of Warp alone.

    Attributes:
        stream: where launches run on CUDA; None: on Warp's current stream of the device.
    """

    stream: wp.Stream | None = None

    def empty(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> Any:
        """A new array, not initialised."""
        return wp.empty(shape, dtype=dtype, device=device)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> Any:
        """A new array of zeros."""
        return wp.zeros(shape, dtype=dtype, device=device)

    def last(self, array: Any) -> Any:
        """The last number, or numbers, of an array of integers. Waits for the device."""
        return array[len(array) - 1 :].numpy()[0].tolist()


class _Memory(threading.local):
    """Where this thread's steps get their arrays from, and the stream they use them on."""

    source: Any = WarpMemory()


memory = _Memory()


def empty(shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> Any:
    """A new array, not initialised: a ``wp.array``, or a view of memory of whoever set ``memory.source``."""
    return memory.source.empty(shape, dtype, device)


def zeros(shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> Any:
    """As ``empty``, filled with zeros."""
    return memory.source.zeros(shape, dtype, device)
