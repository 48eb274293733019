"""Frames whose pixels are on the disk, read by other processes while steps run: torch's DataLoader.

The order of the frames is known ahead, so that a frame lies in memory when its step begins; on CUDA in pinned memory,
from where it is copied to the device during the step before. What is read ahead stays within the bound.
"""

import gc
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any, NamedTuple

import cv2
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.images.jpeg_warnings import decode_alone
from thermosplat.datasets.large_captures import processes_here
from thermosplat.datasets.stored_pixels import ImageLostError, StoredPixels
from thermosplat.errors import UserError

MOST_WORKERS = 16
"""More processes wait for the disk, or for each other's memory."""
_AHEAD = 2
"""Frames that each process has in hand, or ready."""
_IN_USE = 3
"""Frames in memory beside those: of the step, of the next one, and one in between."""


class ReadFrame(NamedTuple):
    """Pixels of a frame in the host's memory."""

    place: int
    """The frame's place among all."""
    views: dict[str, tuple[Tensor, Tensor | None]]
    """Image (uint8 or float32 [H, W, C]) and intensity (float32 [H, W], of pseudo-colours) by spectrum."""


def read_frame(frame: Frame, index: int) -> ReadFrame:
    """Pixels of a frame, in this process.

    Args:
        frame: A frame whose views are on the disk.
        index: Its place among all.

    Raises:
        ImageLostError: A file cannot be read, or is another one than it was.
    """
    views: dict[str, tuple[Tensor, Tensor | None]] = {}
    for name, stored in stored_views(frame).items():
        image, intensity = stored.read_to_train()
        views[name] = torch.from_numpy(image), None if intensity is None else torch.from_numpy(intensity)
    return ReadFrame(index, views)


def stored_views(frame: Frame) -> dict[str, StoredPixels]:
    """Where the pixels of a frame's views are, by spectrum."""
    return {name: view.stored for name, view in frame.views.items() if view.stored is not None}


def num_workers(frames: Sequence[Frame], memory: float) -> int:
    """How many processes may read frames ahead.

    Args:
        frames: The frames.
        memory: What images may take [bytes].

    Raises:
        UserError: It is too little for one.
    """
    stored = [stored_views(frame).values() for frame in frames]
    frame_bytes = max(sum(pixels.trained_bytes for pixels in views) for views in stored)
    reading = max(pixels.reading_bytes for pixels in chain.from_iterable(stored))
    kept, each = _IN_USE * frame_bytes + reading, reading + _AHEAD * frame_bytes
    if memory < kept + each:
        least = 0.001 * -(-(kept + each) // 10**6)
        raise UserError(
            f"--image-memory {memory / 1e9:g} is too little to read one frame of this capture after the other: "
            f"{least:.3f} GB are needed at least.",
            f"Give --image-memory {least:.3f} or more, or train on smaller images: --data-factor 2.",
        )
    cores = len(os.sched_getaffinity(0)) // processes_here()
    return int(max(1, min((memory - kept) // each, MOST_WORKERS, cores)))


class FrameLoader:
    """Reads frames ahead, in one order at a time.

    Args:
        frames: The frames, by index.
        workers: Processes that read.
        pinned: Put them into pinned memory.

    Attributes:
        waited: Time that was spent waiting for frames [s].
    """

    def __init__(self, frames: Sequence[Frame], workers: int, *, pinned: bool) -> None:
        self.workers = workers
        self.waited = 0.0
        self._frames = _Frames(frames)
        self._pinned = pinned
        self._steps: Iterator[Any] | None = None
        self._last: tuple[int, ReadFrame] | None = None

    def at(self, place: int, order: Callable[[int], int], end: int) -> ReadFrame:
        """The frame at a place of an order; those of the next places are read meanwhile.

        Args:
            place: The place.
            order: Index of the frame at each place. It may change: then what was read ahead is read anew.
            end: One beyond the last place.

        Raises:
            ImageLostError: An image of the frame cannot be read.
            UserError: A process that reads was ended by the system.
        """
        if self._last is not None and (self._last[0], self._last[1].place) == (place, order(place)):
            return self._last[1]
        found = None if self._steps is None else self._next(self._steps)
        if found is None or found.place != order(place):
            self.close()
            self._steps = self._started(order(later) for later in range(place, end))
            found = self._next(self._steps)
        if found is None:
            raise ValueError(f"The order ends before place {place}.")
        self._last = place, found
        return found

    def each(self, indices: Iterable[int]) -> Iterator[ReadFrame]:
        """Frames one after the other.

        Args:
            indices: Their order.

        Raises:
            ImageLostError: As ``at``.
            UserError: As ``at``.
        """
        self.close()  # two orders at a time would take twice the memory
        reading = self._started(indices)
        while (found := self._next(reading)) is not None:
            yield found

    def close(self) -> None:
        """End the processes that read for ``at``; the next call starts others."""
        self._steps = self._last = None

    def _started(self, indices: Iterable[int]) -> Iterator[Any]:
        for pixels in stored_views(self._frames.frames[0]).values():
            pixels.prepare()  # once, for all processes that are forked now
        loader = DataLoader(
            self._frames,
            batch_size=None,
            sampler=indices,
            num_workers=self.workers,
            prefetch_factor=_AHEAD,
            pin_memory=self._pinned,
            collate_fn=_as_it_is,
            worker_init_fn=_start_worker,
            multiprocessing_context="fork",
        )
        with _signals_of_children_kept():
            return iter(loader)

    def _next(self, reading: Iterator[Any]) -> ReadFrame | None:
        started = time.perf_counter()
        try:
            found = next(reading, None)
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            raise _ended(reading) from error
        self.waited += time.perf_counter() - started
        if isinstance(found, ImageLostError):
            raise found
        return None if found is None else ReadFrame(*found)


class _Frames(Dataset[Any]):
    """Frames as the processes read them."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[int, dict[str, Any]] | ImageLostError:
        """An error is handed over: raised here it would come out with the traceback for a message."""
        try:
            return index, read_frame(self.frames[index], index).views
        except ImageLostError as error:
            return error


def _as_it_is(item: Any) -> Any:
    return item


def _start_worker(number: int) -> None:
    """Leave signals to the process that trains, and threads out: those of its OpenCV are not here."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    cv2.setNumThreads(0)
    gc.freeze()  # what the other process has made, some of it on a GPU, is not to be collected here
    decode_alone()


@contextmanager
def _signals_of_children_kept() -> Iterator[None]:
    """DataLoader would raise an error for a process that ended in the middle of whatever is done: the state might be
    that of half a step. Without its handler the next frame that is asked for tells."""
    try:
        before = signal.getsignal(signal.SIGCHLD)
        yield
    finally:
        if signal.getsignal(signal.SIGCHLD) is not before:
            signal.signal(signal.SIGCHLD, before if before is not None else signal.SIG_DFL)


def _ended(reading: Any) -> ImageLostError:
    """What to say of a process that is gone."""
    codes = [process.exitcode for process in getattr(reading, "_workers", [])]
    if -signal.SIGBUS in codes:
        return ImageLostError(
            "A process that reads images found no room in the shared memory (/dev/shm).",
            "Give it more room (docker run --shm-size 8g), or read less ahead with a smaller --image-memory.",
        )
    return ImageLostError(
        "A process that reads images was ended by the system, as it does where memory is short.",
        "Let images take less memory with a smaller --image-memory, or train on smaller ones: --data-factor 2.",
    )
