"""Memory in which frames lie between the process that reads them and the device.

All processes have it in common, so that pixels are written once, to where the device copies them from. It is divided
into slots of one frame each. In a slot lie the image, the intensity and the mask of each spectrum, as they are kept on
the disk.
"""

import contextlib
import math
import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.stored_pixels import StoredPixels, TrainedPixels

_ALIGNED = 64
"""Bytes that everything starts at a multiple of: a line of the processor's cache."""


@dataclass(frozen=True)
class PixelPlace:
    """Where the pixels of a view lie in its frame's slot.

    Args:
        image: First byte of the image.
        shape: [H, W, C] of the image.
        is_bytes: The image is uint8, not float32.
        intensity: First byte of the intensity, float32 [H, W]; None where there is none.
        mask: First byte of the mask, bool [H, W]; None where there is none.
        end: One beyond the last byte.
    """

    image: int
    shape: tuple[int, int, int]
    is_bytes: bool
    intensity: int | None
    mask: int | None
    end: int

    @classmethod
    def after(cls, start: int, stored: StoredPixels) -> "PixelPlace":
        """The place of a view's pixels behind what ends at a byte."""
        height, width = stored.camera.height, stored.camera.width
        is_bytes = stored.meaning.has_colors
        image = _aligned(start)
        end = image + (1 if is_bytes else 4) * height * width * stored.channels
        intensity = _aligned(end) if stored.has_intensity else None
        if intensity is not None:
            end = intensity + 4 * height * width
        mask = _aligned(end) if stored.may_be_masked else None
        if mask is not None:
            end = mask + height * width
        return cls(image, (height, width, stored.channels), is_bytes, intensity, mask, end)

    def arrays(self, slot: NDArray[np.uint8]) -> TrainedPixels:
        """Image, intensity and mask in a slot's bytes, in place."""
        return TrainedPixels(*self._parts(slot, np.uint8, np.float32, np.bool_))

    def tensors(self, slot: Tensor) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Image, intensity and mask in a slot's bytes, uint8 [n] on any device, in place."""
        return self._parts(slot, torch.uint8, torch.float32, torch.bool)

    def _parts(self, slot: Any, byte: Any, number: Any, truth: Any) -> tuple[Any, Any, Any]:
        """The same of an array or a tensor, with its library's names of types."""
        height, width, channels = self.shape

        def part(start: int | None, type_of: Any, size: int, shape: tuple[int, ...]) -> Any:
            if start is None:
                return None
            return slot[start : start + size * math.prod(shape)].view(type_of).reshape(shape)

        return (
            part(self.image, byte if self.is_bytes else number, 1 if self.is_bytes else 4, (height, width, channels)),
            part(self.intensity, number, 4, (height, width)),
            part(self.mask, truth, 1, (height, width)),
        )


def places_in_slot(stored: Mapping[str, StoredPixels]) -> dict[str, PixelPlace]:
    """Where the pixels of a frame's views lie in its slot.

    Args:
        stored: Where they are on the disk, by spectrum.
    """
    places: dict[str, PixelPlace] = {}
    end = 0
    for name, pixels in stored.items():
        places[name] = PixelPlace.after(end, pixels)
        end = places[name].end
    return places


def slot_bytes(stored: Mapping[str, StoredPixels]) -> int:
    """What a frame takes of a slot [bytes]."""
    return _aligned(max((place.end for place in places_in_slot(stored).values()), default=0))


def _aligned(count: int) -> int:
    return -(-count // _ALIGNED) * _ALIGNED


class FrameSlots:
    """The memory.

    Args:
        count: Slots.
        size: Of a slot [bytes].

    Raises:
        OSError: There is no room for it.
    """

    def __init__(self, count: int, size: int) -> None:
        self._memory = mmap.mmap(-1, max(count * size, 1))
        self._bytes = np.frombuffer(self._memory, np.uint8, count * size).reshape(count, size)
        self._pinned_for: torch.device | None = None

    def __len__(self) -> int:
        return len(self._bytes)

    def __getitem__(self, slot: int) -> NDArray[np.uint8]:
        """The bytes of a slot, in place."""
        return self._bytes[slot]

    @property
    def is_pinned(self) -> bool:
        """CUDA copies from the memory while the host does something else."""
        return self._pinned_for is not None

    def pin(self, device: torch.device) -> None:
        """Pin the memory for copies to a CUDA device. Where it cannot be pinned, copies wait for each other instead."""
        with torch.cuda.device(device):
            if int(torch.cuda.cudart().cudaHostRegister(self._bytes.ctypes.data, self._bytes.nbytes, 0)) == 0:
                self._pinned_for = device
                return
            # CUDA tells an error again to whoever asks next, and then forgets it
            with contextlib.suppress(RuntimeError):
                torch.zeros((), device=device).fill_(1.0)

    def unpin(self) -> None:
        """Wait for the copies, and undo ``pin``; the memory goes when nobody refers to it."""
        device, self._pinned_for = self._pinned_for, None
        if device is not None:
            with contextlib.suppress(RuntimeError), torch.cuda.device(device):
                torch.cuda.synchronize(device)
                torch.cuda.cudart().cudaHostUnregister(self._bytes.ctypes.data)
