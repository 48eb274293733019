"""Images that are there twice, and images that show nothing."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View
from thermosplat.spectra import label

_SAMPLES = 48
"""Pixels per side that are compared. They are single pixels, not means, so that the noise of two exposures tells."""
_SAME = 0.02
"""Root mean square difference, in standard deviations of the image, below which two images are one: a level of a
photograph. Open choice: neighbouring images of good captures differ by 0.1 and more."""
_CONSTANT = 1.0 / 255
"""Range of intensities [0, 1] below which an image shows nothing."""
_MOST = 3000
"""Images that are compared: all pairs of them take a second."""


def repeated_notes(spectrum: str, train: Sequence[View], test: Sequence[View]) -> list[str]:
    """Sentences (at most three) on images of one value, on held-out images that are trained on, and on images twice.

    Args:
        train: Training images.
        test: Held-out images.
    """
    views = [*train, *test][:_MOST]
    what = f"{label(spectrum)} images"
    samples = [_sample(view) for view in views]
    blank = [view for view, sample in zip(views, samples) if _is_blank(sample)]
    notes = []
    if blank:
        notes.append(
            f"{len(blank)} of {len(views)} {what} have one value everywhere (first: {blank[0].path.name}): the lens "
            "was covered, or the file is damaged. Remove them."
        )
    rich = [number for number, sample in enumerate(samples) if not _is_blank(sample)]
    twins = _twins([samples[number] for number in rich])
    pairs = [(rich[one], rich[two]) for one, two in twins]
    leaked = {two: one for one, two in pairs if one < len(train) <= two}
    if leaked:
        two, one = next(iter(leaked.items()))
        notes.append(
            f"{len(leaked)} of {len(test)} held-out {what} are training images as well (first: {views[two].path.name} "
            f"is {views[one].path.name}): their numbers say nothing. Remove one of each."
        )
    others = {two: one for one, two in pairs if (one < len(train)) == (two < len(train))}
    if others:
        two, one = next(iter(others.items()))
        notes.append(
            f"{len(others)} of {len(views)} {what} are there twice (first: {views[two].path.name} is "
            f"{views[one].path.name}). Remove the copies: their poses cannot differ."
        )
    return notes


def shows_something(view: View) -> bool:
    """Whether an image has more than one value."""
    return not _is_blank(_sample(view))


def _is_blank(sample: NDArray[np.float32]) -> bool:
    return float(np.ptp(sample)) < _CONSTANT


def _sample(view: View) -> NDArray[np.float32]:
    """Single pixels of an image, spread over it, as intensities."""
    image = view.pixels().image
    rows, columns = (np.linspace(0, side - 1, min(side, _SAMPLES)).round().astype(int) for side in image.shape[:2])
    chosen = image[rows[:, None], columns]
    return (chosen.astype(np.float32) / (255 if chosen.dtype == np.uint8 else 1)).ravel()


def _twins(samples: Sequence[NDArray[np.float32]]) -> list[tuple[int, int]]:
    """Pairs of images that are one, by their places, the earlier first."""
    found = []
    for size in dict.fromkeys(len(sample) for sample in samples):
        places = [place for place, sample in enumerate(samples) if len(sample) == size]
        table = np.array([samples[place] for place in places], np.float64)
        table -= table.mean(axis=0)  # what all images have in common
        squares = (table**2).mean(axis=1)
        distances = squares[:, None] + squares - 2 * (table @ table.T) / size
        spread = np.array([samples[place].std() for place in places])
        same = np.triu(distances < (_SAME * np.minimum(spread[:, None], spread)) ** 2, 1)
        found += [(places[one], places[two]) for one, two in zip(*np.nonzero(same))]
    return found
