"""Frames whose pixels are on the disk, read ahead by other processes while steps run.

The order of the frames is known ahead, so that a frame lies in memory when its step begins; on CUDA in pinned memory.
What is read ahead stays within the bound.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.large_captures import processes_here
from thermosplat.datasets.lens import KEPT_MAPS
from thermosplat.datasets.stored_pixels import ImageLostError, StoredPixels
from thermosplat.errors import UserError
from thermosplat.training.frames.frame_slots import FrameSlots, slot_bytes
from thermosplat.training.frames.reading_processes import ReadingProcesses

MOST_PROCESSES = 16
"""More wait for the disk, or for each other's memory."""
SPARE_SLOTS = 5
"""Slots beside one for each process: frames that are ready, and those that are being copied to a device."""

Stored = Mapping[str, StoredPixels]
"""Where the pixels of a frame are, by spectrum."""


def stored_views(frame: Frame) -> dict[str, StoredPixels]:
    """Where the pixels of a frame's views are, by spectrum."""
    return {name: view.stored for name, view in frame.views.items() if view.stored is not None}


class SharedMaps(NamedTuple):
    """What the lenses of all frames need to undistort images."""

    stored: list[StoredPixels]
    """An image of each lens."""
    kept: bool
    """They are few: made once, for all processes. Else each process makes those of a frame for that frame."""

    @classmethod
    def of(cls, frames: Sequence[Stored]) -> "SharedMaps":
        """Those of frames; of a lens whose images were all undistorted before nothing is needed."""
        found: dict[object, StoredPixels] = {}
        for pixels in (pixels for frame in frames for pixels in frame.values()):
            if pixels.map_bytes:
                found.setdefault((pixels.lens, pixels.header.width, pixels.header.height), pixels)
        return cls(list(found.values()), len(found) <= KEPT_MAPS)


def num_processes(frames: Sequence[Stored], memory: float) -> int:
    """How many processes may read frames ahead.

    Args:
        memory: What images may take [bytes].

    Raises:
        UserError: It is too little for one.
    """
    maps = SharedMaps.of(frames)
    frame_bytes = max(map(slot_bytes, frames))
    reading = max(pixels.reading_bytes for frame in frames for pixels in frame.values())
    # this process may read a frame itself, too
    kept, each = (SPARE_SLOTS + 1) * frame_bytes + reading, reading + frame_bytes
    if maps.kept:
        kept += sum(pixels.map_bytes for pixels in maps.stored)
    else:
        of_frame = max(sum(pixels.map_bytes for pixels in frame.values()) for frame in frames)
        kept, each = kept + KEPT_MAPS * max(p.map_bytes for p in maps.stored), each + of_frame
    if memory < kept + each:
        least = 0.001 * -(-(kept + each) // 10**6)
        raise UserError(
            f"--image-memory {memory / 1e9:g} is too little to read one frame of this capture after the other: "
            f"{least:.3f} GB are needed at least.",
            f"Give --image-memory {least:.3f} or more, or train on smaller images: --data-factor 2.",
        )
    cores = len(os.sched_getaffinity(0)) // processes_here()
    return int(max(1, min((memory - kept) // each, MOST_PROCESSES, cores)))


@dataclass(eq=False)
class ReadFrame:
    """A frame in a slot, until it is released.

    Args:
        place: Its place in the order.
        index: Which frame it is.
        slot: Where its pixels are.
        pixels: The slot's bytes, uint8 [n]; pinned on CUDA.
    """

    place: int
    index: int
    slot: int
    pixels: Tensor
    done: bool = False
    lost: ImageLostError | None = None


class FrameLoader:
    """Reads frames ahead, in one order at a time.

    Processes begin to read when a frame is asked for, and end with ``close``.

    Args:
        frames: Where the pixels of each frame are.
        processes: How many read.
        pinned_for: The CUDA device that frames are copied to while the host does something else; None: there is none.

    Attributes:
        processes: As given.
        waited: Time that was spent waiting for frames to be read [s].
        reading: The processes that read; None: there are none now.
    """

    def __init__(self, frames: Sequence[Stored], processes: int, pinned_for: torch.device | None = None) -> None:
        self.processes = processes
        self.waited = 0.0
        self.slot_bytes = max(map(slot_bytes, frames))
        self._frames, self._pinned_for = frames, pinned_for
        self._slots: FrameSlots | None = None
        self._pixels: list[Tensor] = []
        self.reading: ReadingProcesses | None = None
        self._asked: deque[ReadFrame] = deque()
        self._in_work: dict[int, ReadFrame] = {}
        self._free: list[int] = []
        self._upcoming: Iterator[tuple[int, int]] = iter(())

    def at(self, place: int, order: Callable[[int], int], end: int) -> ReadFrame:
        """The frame at a place of an order; those of the next places are read meanwhile.

        Args:
            order: Index of the frame at each place. It may change: then what was read ahead is read anew.
            end: One beyond the last place.

        Returns:
            The frame, which keeps its slot until it is given to ``release``.

        Raises:
            ImageLostError: An image of the frame cannot be read.
            UserError: A process that reads was ended by the system.
            ValueError: All slots hold frames that were not released.
        """
        try:
            if not self._is_next(place, order):
                self._begin(place, order, end)
            self._hear(wait=False)
            found = self._asked[0]
            started = time.perf_counter()
            while not found.done:
                self._hear(wait=True)
            self.waited += time.perf_counter() - started
            if found.lost is not None:
                raise found.lost
            return self._asked.popleft()
        except BaseException:  # an interrupt may have come between two lines
            self.close()
            raise

    def is_ready(self, place: int, order: Callable[[int], int]) -> bool:
        """Whether ``at`` would return the frame at once; of a lost one it tells when its step comes.

        The arguments are those of ``at``.
        """
        if self.reading is None:
            return False
        self._hear(wait=False)
        return self._is_next(place, order) and self._asked[0].done and self._asked[0].lost is None

    def each(self, indices: Sequence[int]) -> Iterator[ReadFrame]:
        """Frames one after the other; each is to be released before the next ones.

        Args:
            indices: Their order.

        Raises:
            ImageLostError: As ``at``.
            UserError: As ``at``.
        """
        return (self.at(place, indices.__getitem__, len(indices)) for place in range(len(indices)))

    def release(self, frame: ReadFrame) -> None:
        """Let another frame be read into the slot of one; nothing is done for a frame from before ``close``.

        Args:
            frame: A frame that ``at`` returned.
        """
        if self._pixels and frame.pixels is self._pixels[frame.slot]:
            self._free.append(frame.slot)
            self._ask()

    def close(self) -> None:
        """End the processes that read; the next call starts others. No frame is used any more."""
        reading, self.reading = self.reading, None
        slots, self._slots = self._slots, None
        for held in (self._asked, self._in_work, self._free, self._pixels):
            held.clear()
        if reading is not None:
            reading.close()
        if slots is not None:
            slots.unpin()

    def _is_next(self, place: int, order: Callable[[int], int]) -> bool:
        if not self._asked:
            return False
        first = self._asked[0]
        return (first.place, first.index) == (place, order(place))

    def _begin(self, place: int, order: Callable[[int], int], end: int) -> None:
        """Read in an order from now on."""
        if self.reading is None:
            self._start()
        else:
            self._forget_order()
        self._upcoming = ((later, order(later)) for later in range(place, end))
        self._ask()
        while not self._asked and self._in_work and place < end:
            self._hear(wait=True)  # of an order that was forgotten, in the last slots
        if not self._asked:
            wrong = "All slots are held." if place < end else f"The order ends before place {place}."
            raise ValueError(wrong)

    def _start(self) -> None:
        count = self.processes + SPARE_SLOTS
        try:
            slots = self._slots = FrameSlots(count, self.slot_bytes)
        except OSError as error:
            raise ImageLostError(
                f"The host has no memory for the {count} frames that are read ahead ({error.strerror}).",
                "Let images take less memory with a smaller --image-memory, or train on smaller ones: --data-factor 2.",
            ) from error
        maps = SharedMaps.of([frame for frame in self._frames if not all(p.is_kept for p in frame.values())])
        for pixels in maps.stored if maps.kept else ():
            pixels.prepare()  # once, for all processes that are forked now
        self.reading = ReadingProcesses(self._frames, slots, self.processes, keep_maps=maps.kept)
        if self._pinned_for is not None:
            slots.pin(self._pinned_for)  # after the fork, which leaves pinned memory out
        self._pixels = [torch.from_numpy(slots[slot]) for slot in range(count)]
        self._free = list(range(count))

    def _forget_order(self) -> None:
        """Nobody wants what was asked for. What is being read is waited for before its slot serves again."""
        taken_back = set(self._of_reading.take_back())
        for frame in self._asked:
            if frame.done or frame.slot in taken_back:
                self._in_work.pop(frame.slot, None)
                self._free.append(frame.slot)
        self._asked.clear()

    def _ask(self) -> None:
        """Have the next frames read into the slots that are free."""
        while self._free and (upcoming := next(self._upcoming, None)) is not None:
            slot = self._free.pop()
            frame = ReadFrame(*upcoming, slot, self._pixels[slot])
            self._asked.append(frame)
            self._in_work[slot] = frame
            self._of_reading.ask(slot, frame.index)

    def _hear(self, *, wait: bool) -> None:
        """Note which frames were read."""
        for slot, lost in self._of_reading.answered(wait=wait):
            frame = self._in_work.pop(slot)
            frame.done, frame.lost = True, lost
            if frame not in self._asked:  # of an order that was forgotten
                self._free.append(slot)
                self._ask()

    @property
    def _of_reading(self) -> ReadingProcesses:
        if self.reading is None:
            raise ValueError("No process reads.")
        return self.reading
