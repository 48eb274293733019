"""The training frames as tensors: kept on the device as far as memory allows, or read from the disk ahead of the steps.

What a frame holds is the same either way, to the bit on the CPU. On the device images stay the bytes that their files
have, in a quarter of the memory.

Which frame and which spectra a step trains is said here, too, and which steps train a set of Gaussians. Steps count
from 1; a span (start, end) holds the steps start + 1 to end.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, overload

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import (
    FrameTensors,
    frame_tensors,
    packed,
    with_unit_images,
)
from thermosplat.errors import UserError
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.training.frames.frames_from_disk import FramesFromDisk
from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.frames.shrunk_frames import ShrunkFrames

_CACHED_SHARE = 0.25
"""Share of the free memory that frames may fill; Gaussians and the renderer need the rest."""


class TrainFrames:
    """The frames to learn from, in the capture's order, by index.

    Args:
        capture: The capture. Frames without a view that the model renders are left out.
        spectra: Names of the spectra that are modelled; frames hold no others.

    Attributes:
        room: Bytes that further frames may fill.

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
        self.room = _CACHED_SHARE * free_bytes(device)

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
        if self.reserve(frame.num_bytes):
            self._cache[index] = frame
        return frame

    def reserve(self, size: int) -> bool:
        """Whether there is memory to keep so many bytes more, which is then taken; less than 0 gives some back."""
        if size > self.room:
            return False
        self.room -= size
        return True

    def at(self, place: int, order: Callable[[int], int], end: int) -> FrameTensors:
        """Packed tensors of the frame at a place of an order. Images may be bytes, which a step makes floats of.

        Args:
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
    """Some of the frames, made when they are looked at."""

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


def free_bytes(device: torch.device) -> int:
    """Memory that is free: of the GPU, or of the machine where training runs on the CPU; 0: nobody knows."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):  # with what the file cache would give back
            return int(line.split()[1]) * 1024
    return 0


class Span(NamedTuple):
    """The steps in which something is trained."""

    start: int
    end: int

    def __contains__(self, step: object) -> bool:
        return isinstance(step, int) and self.start < step <= self.end

    def progress(self, steps_done: int) -> float:
        """Share of the span that is done, 0 to 1."""
        return min(max((steps_done - self.start) / max(self.end - self.start, 1), 0.0), 1.0)


def spectrum_spans(config: TrainConfig) -> dict[str, Span]:
    """The steps that train on the images of each modelled spectrum."""
    steps = config.max_steps
    return {
        name: Span(round(spectrum.train_from * steps), round(spectrum.train_until * steps))
        for name, spectrum in config.modelled.items()
    }


def set_span(name: str, config: TrainConfig) -> Span:
    """The steps that train a set of Gaussians, or the decoders.

    Args:
        name: A spectrum's name for its own set; anything else is trained by every step.
    """
    return spectrum_spans(config).get(name, Span(0, config.max_steps))


class FrameOrder:
    """Which training frame each step takes: all of them in random order, then all again in another. 3DGS.

    Args:
        num_frames: Training frames, at least 1.
    """

    def __init__(self, num_frames: int, seed: int) -> None:
        self.num_frames = num_frames
        self.seed = seed
        self._epoch = -1
        self._order: list[int] = []

    def __getitem__(self, step: int) -> int:
        """Index of the frame of a step, 0 being the first step."""
        epoch, place = divmod(step, self.num_frames)
        if epoch != self._epoch:
            stream = random_stream(self.seed, "frame order", epoch)
            self._epoch, self._order = epoch, torch.randperm(self.num_frames, generator=stream).tolist()
        return self._order[place]


class SpectrumSchedule:
    """The frame of every step, with the views that the step trains on.

    Raises:
        UserError: If some step would have no frame to learn from.
    """

    def __init__(self, config: TrainConfig, frames: TrainFrames) -> None:
        self._spans = spectrum_spans(config)
        self._frames = frames
        self._sized = ShrunkFrames(frames)
        self._seed = config.seed
        self._size = config.batch_size or 1
        self._steps = config.max_steps
        self.places: Sequence[int] = range(self._size)
        """Places of the frames, among those of each step, that this process renders."""
        self._starts = {0, *(boundary for span in self._spans.values() for boundary in span)} - {config.max_steps}
        self._trained: dict[frozenset[str], tuple[list[int], FrameOrder]] = {}
        self._withheld: Collection[int] = ()
        self.withhold(())

    def shuffle(self, seed: int) -> None:
        """Take the frames in another order from now on."""
        self._seed = seed
        self.withhold(self._withheld)

    def withhold(self, indices: Collection[int]) -> None:
        """Train on all frames but these from now on.

        Raises:
            UserError: If some step would have no frame to learn from.
        """
        self._withheld = indices
        for start in self._starts:
            shown = self.shown(start)
            having = [
                index
                for index, frame in enumerate(self._frames.frames)
                if shown & frame.views.keys() and index not in indices
            ]
            if not having:
                raise UserError(
                    f"No training frame has what step {start + 1:,} is to learn from.",
                    "Look at train_from and train_until of the spectra, and at the capture's images.",
                )
            self._trained[shown] = having, FrameOrder(len(having), self._seed)

    def frame(self, steps_done: int) -> Frame:
        """The (first) frame of the step that follows ``steps_done`` steps."""
        return self._frames.frames[self._index(steps_done)]

    def tensors(self, steps_done: int, number: int = 0, *, factor: float = 1.0) -> FrameTensors:
        """A frame of that step on the device, with the views alone that the step trains on.

        Frames that stay on the disk are read ahead if they are asked for in their order.

        Args:
            number: Which of the step's frames that this process renders; without any of them there is no view.
            factor: What the sides of the images are divided by.
        """
        count = len(self.places)
        if not count:
            return FrameTensors("", {}, ())
        place, end = steps_done * count + number, self._steps * count
        if factor == self._sized.factor == 1.0:
            frame = self._frames.at(place, self._at_place, end)
        else:
            frame = self._sized.at(place, self._at_place, end, factor)
        return frame.only(self.shown(steps_done))

    def _at_place(self, place: int) -> int:
        """Index of a frame that this process renders, counted from the first step on."""
        steps_done, number = divmod(place, len(self.places))
        return self._index(steps_done, self.places[number])

    def batch(self, steps_done: int) -> list[int]:
        """Indices of the frames of the step that follows ``steps_done`` steps."""
        return [self._index(steps_done, place) for place in range(self._size)]

    def _index(self, steps_done: int, place: int = 0) -> int:
        having, order = self._trained[self.shown(steps_done)]
        return having[order[steps_done * self._size + place]]

    def shown(self, steps_done: int) -> frozenset[str]:
        """Spectra that the step after so many trains on."""
        return frozenset(name for name, span in self._spans.items() if steps_done + 1 in span)
