"""Training frames whose pixels stay on the disk, as tensors; on CUDA copied to the device while earlier steps run."""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import FrameTensors, packed, with_pixels, without_pixels
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.frames.frame_loader import FrameLoader, ReadFrame, num_processes, stored_views
from thermosplat.training.frames.frame_slots import places_in_slot

COPIED_AHEAD = 3
"""Frames on a CUDA device, as bytes, that no step has begun with."""

_Parts = tuple[Tensor, Tensor | None, Tensor | None]
"""Image, intensity and mask of a view."""


class FramesFromDisk:
    """The frames, each made when it is asked for. Images that are bytes stay bytes (``with_unit_images``).

    Args:
        scales: The capture's, by spectrum.
        memory: What images may take in the host's memory [bytes].

    Attributes:
        loader: What reads them.

    Raises:
        UserError: The memory is too little for one frame.
    """

    def __init__(
        self, frames: Sequence[Frame], scales: Mapping[str, PixelScale], device: torch.device, memory: float
    ) -> None:
        self._frames, self._scales, self._device = frames, scales, device
        self._stored = [stored_views(frame) for frame in frames]
        on_cuda = device.type == "cuda"
        self.loader = FrameLoader(self._stored, num_processes(self._stored, memory), device if on_cuda else None)
        self.copies = FrameCopies(self.loader, device) if on_cuda else None
        self._cameras = [{name: without_pixels(view, device) for name, view in f.views.items()} for f in frames]
        self._indices = torch.arange(len(frames), device=device)
        self._now: tuple[int, int, FrameTensors] | None = None
        """A place of an order, the index there, and the frame."""

    def __getitem__(self, index: int) -> FrameTensors:
        """A frame out of any order, read by this process."""
        views: dict[str, _Parts] = {}
        for name, stored in self._stored[index].items():
            stored.check()
            image, *others = stored.read_to_train()
            on_device = torch.from_numpy(image).to(self._device)
            intensity, mask = (None if one is None else torch.from_numpy(one).to(self._device) for one in others)
            views[name] = on_device, intensity, mask
        return self._frame(index, views)

    def each(self) -> Iterator[FrameTensors]:
        """All frames in their order, read ahead."""
        count = len(self._frames)
        return (self._at(place, range(count).__getitem__, count) for place in range(count))

    def at(self, place: int, order: Callable[[int], int], end: int) -> FrameTensors:
        """As ``TrainFrames.at``."""
        index = order(place)
        if self._now is None or self._now[:2] != (place, index):
            self._now = None  # its memory may serve for the next one
            self._now = place, index, self._at(place, order, end)
        return self._now[2]

    def close(self) -> None:
        """End what reads ahead."""
        self._now = None
        if self.copies is not None:
            self.copies.forget()
        self.loader.close()

    def _at(self, place: int, order: Callable[[int], int], end: int) -> FrameTensors:
        if self.copies is None:
            read = self.loader.at(place, order, end)
            frame = self.of_slot(read.index, read.pixels)
            self.loader.release(read)
            return frame
        try:
            copy = self.copies.at(place, order, end)
            frame = self.of_slot(copy.index, copy.pixels)
            self.copies.is_used(copy)
            self.copies.go_on(place + 1, order, end)
        except BaseException:  # an interrupt may have come between two lines
            self.close()
            raise
        return frame

    def of_slot(self, index: int, pixels: Tensor) -> FrameTensors:
        """A frame of the bytes of a slot, uint8 [n] on the device."""
        places = places_in_slot(self._stored[index])
        return self._frame(index, {name: place.tensors(pixels) for name, place in places.items()})

    def _frame(self, index: int, views: Mapping[str, _Parts]) -> FrameTensors:
        frame, cameras = self._frames[index], self._cameras[index]
        tensors = {
            name: with_pixels(cameras[name], image, intensity, self._scales[name], mask)
            for name, (image, intensity, mask) in views.items()
        }
        return packed(FrameTensors(frame.name, tensors, frame.shared_cameras, self._indices[index]))


@dataclass(frozen=True, eq=False)
class _Copy:
    """A frame whose bytes are on the device, or on their way to it."""

    place: int
    index: int
    number: int
    """Which of the device's slots it is in."""
    pixels: Tensor
    """That slot, uint8 [n]."""
    ended: torch.cuda.Event
    """The bytes are there."""


class FrameCopies:
    """Copies frames to a CUDA device on a stream of its own, some frames before their steps.

    The host is never more than some frames ahead of the device: it waits for a copy when ``COPIED_AHEAD`` of them are
    on their way, and a copy waits for the step that used its slot before.

    Attributes:
        ahead: Time that the host has spent waiting for the device [s].
    """

    def __init__(self, loader: FrameLoader, device: torch.device) -> None:
        self.ahead = 0.0
        self._loader, self._device = loader, device
        self._stream = torch.cuda.Stream(device)
        self._slots = torch.empty((COPIED_AHEAD, loader.slot_bytes), dtype=torch.uint8, device=device)
        self._stream.wait_stream(torch.cuda.current_stream(device))  # of which the slots' memory may come
        self._slots.record_stream(self._stream)
        self._used: list[torch.cuda.Event | None] = [None] * COPIED_AHEAD
        self._next = 0
        self._copies: deque[_Copy] = deque()
        self._under_way: deque[tuple[torch.cuda.Event, ReadFrame]] = deque()

    def at(self, place: int, order: Callable[[int], int], end: int) -> _Copy:
        """The frame at a place of an order, for work on the current stream."""
        self._release()
        if not self._copies or (self._copies[0].place, self._copies[0].index) != (place, order(place)):
            self._copies.clear()
            self._copy(place, order, end)
        copy = self._copies.popleft()
        torch.cuda.current_stream(self._device).wait_event(copy.ended)
        return copy

    def is_used(self, copy: _Copy) -> None:
        """Say that all work with the bytes of a frame was given to the current stream."""
        self._used[copy.number] = torch.cuda.current_stream(self._device).record_event()

    def go_on(self, place: int, order: Callable[[int], int], end: int) -> None:
        """Copy the frames that were read, from a place on. The arguments are those of ``at``."""
        for later in range(place + len(self._copies), min(place + COPIED_AHEAD, end)):
            self._release()
            if not self._loader.is_ready(later, order):
                return
            self._copy(later, order, end)

    def forget(self) -> None:
        """Let the copies go. Memory that they read from may be given up when they have ended."""
        with contextlib.suppress(RuntimeError):  # the device has failed, which others tell
            self._stream.synchronize()
        self._copies.clear()
        self._under_way.clear()

    def _copy(self, place: int, order: Callable[[int], int], end: int) -> None:
        read = self._loader.at(place, order, end)
        number = self._next
        self._next = (number + 1) % COPIED_AHEAD
        used = self._used[number]
        with torch.cuda.stream(self._stream):
            if used is not None:
                self._stream.wait_event(used)
            self._slots[number].copy_(read.pixels, non_blocking=True)
            ended = self._stream.record_event()
        self._under_way.append((ended, read))
        self._copies.append(_Copy(place, read.index, number, self._slots[number], ended))

    def _release(self) -> None:
        """Give slots of the host back whose copies have ended; wait for the first where there are many."""
        while self._under_way and (len(self._under_way) >= COPIED_AHEAD or self._under_way[0][0].query()):
            ended, read = self._under_way.popleft()
            started = time.perf_counter()
            ended.synchronize()
            self.ahead += time.perf_counter() - started
            self._loader.release(read)
