"""The training frames as tensors: kept on the device as far as memory allows, or read from the disk ahead of the steps.

What a frame holds is the same either way, to the bit on the CPU.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, overload

import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import (
    FrameTensors,
    ViewTensors,
    frame_tensors,
    packed,
    packed_memory,
    with_pixels,
    without_pixels,
)
from thermosplat.errors import UserError
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.frames.frame_loader import FrameLoader, ReadFrame, num_workers, read_frame, stored_views

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
        if self.from_disk is not None:
            return self.from_disk.each()
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> FrameTensors:
        """Tensors of a frame; made again each time once the memory for them is full."""
        if self.from_disk is not None:
            return self.from_disk[index]
        if index in self._cache:
            return self._cache[index]
        place = torch.tensor(index, device=self.device)
        frame = packed(replace(frame_tensors(self.frames[index], self.scales, self.device), index=place))
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
        """Tensors of the frame at a place of an order.

        Args:
            place: The place.
            order: Index of the frame at each place.
            end: One beyond the last place.
        """
        return self[order(place)] if self.from_disk is None else self.from_disk.at(place, order, end)

    def close(self) -> None:
        """End what reads ahead; a later call of ``at`` begins again."""
        if self.from_disk is not None:
            self.from_disk.close()


class _Copied(NamedTuple):
    """A frame that was copied to the device before its step."""

    place: int
    number: int
    frame: FrameTensors


class FramesFromDisk:
    """Training frames whose pixels stay on the disk.

    Args:
        frames: The frames.
        scales: The capture's, by spectrum.
        device: Where the tensors go.
        memory: What images may take in the host's memory [bytes].

    Attributes:
        loader: What reads them.

    Raises:
        UserError: The memory is too little for one frame.
    """

    def __init__(
        self, frames: Sequence[Frame], scales: Mapping[str, PixelScale], device: torch.device, memory: float
    ) -> None:
        self.loader = FrameLoader(frames, num_workers(frames, memory), pinned=device.type == "cuda")
        self._frames, self._scales, self._device = frames, scales, device
        self._cameras = [{name: without_pixels(view, device) for name, view in f.views.items()} for f in frames]
        self._indices = torch.arange(len(frames), device=device)
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(device))  # the cameras are there
        self._now: _Copied | None = None
        self._next: _Copied | None = None

    def __getitem__(self, index: int) -> FrameTensors:
        for stored in stored_views(self._frames[index]).values():
            stored.check()
        return self._on_device(read_frame(self._frames[index], index))

    def each(self) -> Iterator[FrameTensors]:
        """All frames in their order, read ahead."""
        return map(self._on_device, self.loader.each(range(len(self._frames))))

    def at(self, place: int, order: Callable[[int], int], end: int) -> FrameTensors:
        """As ``TrainFrames.at``; on CUDA the frame of the next place is copied while that of this one is used."""
        if self._stream is None:
            return self._on_device(self.loader.at(place, order, end))
        wanted = (place, order(place))
        if self._now is not None and (self._now.place, self._now.number) == wanted:
            return self._now.frame
        copied = self._next
        if copied is None or (copied.place, copied.number) != wanted:
            copied = self._copied(place, order, end, self._stream)
        using = torch.cuda.current_stream(self._device)
        using.wait_stream(self._stream)
        packed_memory(copied.frame).record_stream(using)
        self._now = copied
        self._next = self._copied(place + 1, order, end, self._stream) if place + 1 < end else None
        return copied.frame

    def _copied(self, place: int, order: Callable[[int], int], end: int, stream: torch.cuda.Stream) -> _Copied:
        read = self.loader.at(place, order, end)
        with torch.cuda.stream(stream):
            return _Copied(place, read.place, self._on_device(read))

    def close(self) -> None:
        """End what reads ahead."""
        self._now = self._next = None
        self.loader.close()

    def _on_device(self, read: ReadFrame) -> FrameTensors:
        frame, views = self._frames[read.place], {}
        for name, (image, intensity) in read.views.items():
            image = image.to(self._device, non_blocking=True)
            intensity = None if intensity is None else intensity.to(self._device, non_blocking=True)
            views[name] = with_pixels(self._cameras[read.place][name], image, intensity, self._scales[name])
        return packed(FrameTensors(frame.name, views, frame.shared_cameras, self._indices[read.place]))


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
    tensors = [value for value in (view.image, view.intensity, view.values) if isinstance(value, Tensor)]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _free_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):  # with what the file cache would give back
            return int(line.split()[1]) * 1024
    return 0
