"""Which frame and which spectra a step trains, and which steps train a set of Gaussians.

Notation: steps count from 1; a span (start, end) holds the steps start + 1 to end.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.errors import UserError
from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.frames.shrunk_frames import ShrunkFrames
from thermosplat.training.frames.train_frames import TrainFrames


class Span(NamedTuple):
    """The steps in which something is trained."""

    start: int
    """Steps before it."""
    end: int
    """Its last step."""

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
        config: The whole configuration.
    """
    return spectrum_spans(config).get(name, Span(0, config.max_steps))


class FrameOrder:
    """Which training frame each step takes: all of them in random order, then all again in another. 3DGS.

    Args:
        num_frames: Training frames, at least 1.
        seed: The run's seed.
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

    Args:
        config: The whole configuration.
        frames: The training frames.

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
        """Take the frames in another order from now on.

        Args:
            seed: What it comes from.
        """
        self._seed = seed
        self.withhold(self._withheld)

    def withhold(self, indices: Collection[int]) -> None:
        """Train on all frames but these from now on.

        Args:
            indices: Training frames, by index.

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
            steps_done: As of ``frame``.
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
