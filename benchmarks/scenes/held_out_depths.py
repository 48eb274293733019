"""Held-out views whose true depths a capture knows, by spectrum."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, View
from thermosplat.datasets.ground_truth import GroundTruth, read_ground_truth
from thermosplat.evaluation.labelled_regions import DIFFERING

Array = NDArray[np.float64]


class HeldOut(NamedTuple):
    """A held-out view with its true depths."""

    view: View
    truth: GroundTruth
    own: Array
    """True depth [world units], [H, W]; 0 where there is none."""
    other: Array
    """That of the other spectrum's surface."""

    @property
    def differs(self) -> NDArray[np.bool_]:
        """Where the two surfaces differ."""
        return (self.own > 0) & (self.other > 0) & (np.abs(self.own - self.other) > DIFFERING * self.own)

    def differing(self, label: int) -> NDArray[np.bool_]:
        """Pixels of a kind of surface (``LABELS``) where the two surfaces differ."""
        return self.differs & (self.truth.label == label)

    def relative_errors(self, depth: Array) -> Array:
        """Of depths [H, W], where there is a true one, [n]."""
        return (np.abs(depth - self.own) / self.own.clip(1e-9))[self.own > 0]

    def on_own_surface(self, depth: Array) -> NDArray[np.bool_]:
        """Where depths [H, W] are nearer to the spectrum's own surface than to the other's."""
        return (np.abs(depth - self.own) < np.abs(depth - self.other)) & (depth > 0)


def held_out(capture: Capture, name: str) -> Iterator[HeldOut]:
    """The held-out views of a spectrum that have true depths.

    Args:
        capture: The capture.
        name: The spectrum.
    """
    for frame in capture.test:
        truth = read_ground_truth(capture, frame)
        if truth is not None and name in frame.views:
            own, *others = (truth.depths[one].astype(np.float64) for one in sorted(truth.depths, key=name.__ne__))
            yield HeldOut(frame.views[name], truth, own, others[0] if others else own)
