"""The training frames as tensors: kept on the device as far as memory allows, or read from the disk ahead of the steps.

What a frame holds is the same either way, to the bit on the CPU. On the device images stay the bytes that their files
have, in a quarter of the memory.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import (
    FrameTensors,
    ViewTensors,
    frame_tensors,
    packed,
    with_unit_images,
)
from thermosplat.errors import UserError
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.training.frames.frames_from_disk import FramesFromDisk

_CACHED_SHARE = 0.25
"""Share of the free memory that frames may fill; Gaussians and the renderer need the rest."""


class TrainFrames:
    """The frames to learn from, in the capture's order, by index.

    Args:
        capture: The capture. Frames without a view that the model renders are left out.
        spectra: Names of the spectra that are modelled; frames hold no others.
        device: Where the tensors go.

    Raises:
        UserError: If no frame is left, or images may take less memory than a frame needs.
    """

    def __init__(self, capture: Capture, spectra: Collection[str], device: torch.device) -> None:
        self.frames = capture.training_frames(spectra)
        if not self.frames:
            raise UserError(f"{capture.root} has no training frame of a spectrum that is modelled.")
        self.scales = capture.scales
        self.device = device
        self.from_disk: FramesFromDisk | None = None
        if capture.on_disk is not None:
            self.from_disk = FramesFromDisk(self.frames, capture.scales, device, capture.on_disk.memory)
        self._cache: dict[int, FrameTensors] = {}
        self._budget = _CACHED_SHARE * _free_bytes(device)

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[FrameTensors]:
        frames = map(self._kept, range(len(self))) if self.from_disk is None else self.from_disk.each()
        return map(with_unit_images, frames)

    def __getitem__(self, index: int) -> FrameTensors:
        """Tensors of a frame."""
        return with_unit_images(self._kept(index) if self.from_disk is None else self.from_disk[index])

    def _kept(self, index: int) -> FrameTensors:
        """A frame whose images may be bytes, packed; made again each time once the memory for frames is full."""
        if index in self._cache:
            return self._cache[index]
        place = torch.tensor(index, device=self.device)
        tensors = frame_tensors(self.frames[index], self.scales, self.device, as_bytes=True)
        frame = packed(replace(tensors, index=place))
        if self.reserve(frame_bytes(frame)):
            self._cache[index] = frame
        return frame

    def reserve(self, size: int) -> bool:
        """Whether there is memory to keep so many bytes more, which is then taken; less than 0 gives some back."""
        if size > self._budget:
            return False
        self._budget -= size
        return True

    def at(self, place: int, order: Callable[[int], int], end: int) -> FrameTensors:
        """Packed tensors of the frame at a place of an order. Images may be bytes, which a step makes floats of.

        Args:
            place: The place.
            order: Index of the frame at each place.
            end: One beyond the last place.
        """
        return self._kept(order(place)) if self.from_disk is None else self.from_disk.at(place, order, end)

    def close(self) -> None:
        """End what reads ahead; a later call of ``at`` begins again."""
        if self.from_disk is not None:
            self.from_disk.close()


class CorrectedFrames:
    """The training frames with their cameras as they are believed to be now.

    Args:
        frames: The frames as the capture has them.
        corrections: What is wrong with the cameras; None: nothing.
    """

    def __init__(self, frames: TrainFrames, corrections: CameraCorrections | None) -> None:
        self.frames = frames.frames
        self._tensors, self._corrections = frames, corrections

    def __len__(self) -> int:
        return len(self._tensors)

    def __iter__(self) -> Iterator[FrameTensors]:
        return map(self._corrected, self._tensors)

    def __getitem__(self, index: int) -> FrameTensors:
        """Tensors of a frame; through its cameras no gradient reaches the corrections."""
        return self._corrected(self._tensors[index])

    @torch.no_grad()
    def _corrected(self, frame: FrameTensors) -> FrameTensors:
        return frame if self._corrections is None else self._corrections(frame)


class SomeFrames(Sequence[FrameTensors]):
    """Some of the frames, made when they are looked at.

    Args:
        frames: All frames.
        indices: Which of them.
    """

    def __init__(self, frames: CorrectedFrames, indices: Sequence[int]) -> None:
        self._frames, self._indices = frames, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, place: int) -> FrameTensors: ...
    @overload
    def __getitem__(self, place: slice) -> "SomeFrames": ...
    def __getitem__(self, place: int | slice) -> "FrameTensors | SomeFrames":
        if isinstance(place, slice):
            return SomeFrames(self._frames, self._indices[place])
        return self._frames[self._indices[place]]


def frame_bytes(frame: FrameTensors) -> int:
    """Memory of the images and values of a frame [bytes]."""
    return sum(map(_bytes, frame.views.values()))


def _bytes(view: ViewTensors) -> int:
    tensors = [value for value in (view.image, view.intensity, view.values, view.mask) if isinstance(value, Tensor)]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _free_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):  # with what the file cache would give back
            return int(line.split()[1]) * 1024
    return 0
