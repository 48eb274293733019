"""Processes that read frames into slots: decoded the first time, and from the disk cache from then on.

One process asks, by a message per frame; whoever of the others is free takes the next message. A socket hands every
message over whole and to one process alone, so nothing is locked, and one that is killed holds nothing that others wait
for.
"""

import gc
import os
import pickle
import signal
import socket
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import connection, get_context
from pathlib import Path

import cv2

from thermosplat.datasets.images.jpeg_warnings import decode_alone
from thermosplat.datasets.lens import rectification
from thermosplat.datasets.stored_pixels import ImageLostError, StoredPixels
from thermosplat.stop_signals import STOP_SIGNALS, held_stop_signals
from thermosplat.training.frames.frame_slots import FrameSlots, places_in_slot

_LONGEST_MESSAGE = 1 << 16
"""[bytes]"""
_LONGEST_TRACEBACK = 1 << 14
"""Letters that a message holds in any case."""
_LOOK_EVERY_S = 5.0
"""How often a process that has nothing to do looks whether it has become an orphan."""
_TO_END_S = 10.0
"""That a process has for the frame in its hands before it is killed."""
_ENDED = ImageLostError(
    "A process that reads images was ended by the system, as it does where memory is short.",
    "Let images take less memory with a smaller --image-memory, or train on smaller ones: --data-factor 2.",
)


@dataclass(frozen=True)
class _Asked:
    """A message to those that read."""

    slot: int
    index: int
    folder: Path | None
    """Of the disk cache."""


@dataclass(frozen=True)
class _Answer:
    """A message from them."""

    slot: int
    lost: tuple[str, str] | None = None
    """Message and hint, if an image of the frame is lost."""
    failed: str | None = None
    """A traceback, if the program has a mistake."""


class ReadingProcesses:
    """The processes, from now on until ``close``.

    Args:
        frames: Where the pixels of each frame are, by spectrum.
        slots: Where they go.
        count: How many processes.
        keep_maps: Keep what a lens needs from one frame to the next.

    Attributes:
        processes: They.
    """

    def __init__(
        self, frames: Sequence[Mapping[str, StoredPixels]], slots: FrameSlots, count: int, *, keep_maps: bool
    ) -> None:
        self._cache = next(pixels.cache for frame in frames for pixels in frame.values())
        self._asking, self._asked = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._answers, self._answering = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours = (self._asking, self._answers)
        work = _Work(frames, slots, self._asked, self._answering, ours, os.getpid(), keep_maps)
        context = get_context("fork")  # what the frames and the lenses need is there, and shared
        self.processes = [context.Process(target=work.run, daemon=True) for _ in range(count)]
        with held_stop_signals():  # until each has decided what they are to it
            for process in self.processes:
                process.start()
        self._asked.setblocking(False)

    def ask(self, slot: int, index: int) -> None:
        """Have a frame read into a slot."""
        self._asking.send(pickle.dumps(_Asked(slot, index, self._cache.folder)))

    def take_back(self) -> list[int]:
        """Slots for which frames were asked that no process has begun to read: they will not be read."""
        slots: list[int] = []
        while True:
            try:
                slots.append(pickle.loads(self._asked.recv(_LONGEST_MESSAGE)).slot)
            except BlockingIOError:
                return slots

    def answered(self, *, wait: bool) -> Iterator[tuple[int, ImageLostError | None]]:
        """Slots whose frames were read, or why not.

        Raises:
            ImageLostError: A process was ended from outside, when there is no answer to wait for.
            RuntimeError: One failed, by a mistake of the program.
        """
        if wait:
            ready = connection.wait([self._answers, *(process.sentinel for process in self.processes)])
            if self._answers not in ready:
                raise _ENDED
        while True:
            try:
                answer: _Answer = pickle.loads(self._answers.recv(_LONGEST_MESSAGE, socket.MSG_DONTWAIT))
            except BlockingIOError:
                return
            if answer.failed is not None:
                raise RuntimeError(f"A process that reads images failed:\n{answer.failed}")
            yield answer.slot, None if answer.lost is None else ImageLostError(*answer.lost)

    def close(self) -> None:
        """End the processes."""
        self.take_back()
        for end in (self._asking, self._asked):
            end.close()  # nobody asks any more: each of them ends
        until = time.monotonic() + _TO_END_S
        for process in self.processes:
            process.join(max(until - time.monotonic(), 0.0))
            if process.is_alive():
                process.kill()
                process.join(1.0)
        for end in (self._answers, self._answering):
            end.close()


class _Work:
    """What one of the processes does."""

    def __init__(
        self,
        frames: Sequence[Mapping[str, StoredPixels]],
        slots: FrameSlots,
        asked: socket.socket,
        answering: socket.socket,
        of_parent: Sequence[socket.socket],
        parent: int,
        keep_maps: bool,
    ) -> None:
        self._frames, self._slots, self._keep_maps = frames, slots, keep_maps
        self._asked, self._answering, self._of_parent, self._parent = asked, answering, of_parent, parent

    def run(self) -> None:
        """Read what is asked for, until nobody asks any more."""
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # they are for the process that trains, which ends this one
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Python's end of it
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
        for end in self._of_parent:
            end.close()
        cv2.setNumThreads(0)  # threads of OpenCV were not copied with the process
        gc.freeze()  # what the other process has made, some of it on a GPU, is not to be collected here
        decode_alone()
        self._asked.settimeout(_LOOK_EVERY_S)
        while True:
            try:
                message = self._asked.recv(_LONGEST_MESSAGE)
            except TimeoutError:
                if os.getppid() != self._parent:
                    return
                continue
            if not message:
                return
            try:
                self._answering.send(pickle.dumps(self._read(pickle.loads(message))))
            except (BrokenPipeError, ConnectionResetError):
                return

    def _read(self, asked: _Asked) -> _Answer:
        frame, slot = self._frames[asked.index], self._slots[asked.slot]
        try:
            for name, place in places_in_slot(frame).items():
                frame[name].cache.folder = asked.folder
                frame[name].read_into(place.arrays(slot))
        except ImageLostError as error:
            return _Answer(asked.slot, lost=(error.message, error.hint or ""))
        except MemoryError:
            return _Answer(asked.slot, lost=("A process that reads images has no memory left.", _ENDED.hint or ""))
        except Exception:
            return _Answer(asked.slot, failed=traceback.format_exc()[-_LONGEST_TRACEBACK:])
        finally:
            if not self._keep_maps:
                rectification.cache_clear()
        return _Answer(asked.slot)
