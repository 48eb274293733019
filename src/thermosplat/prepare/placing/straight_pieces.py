"""Straight pieces of a path: along one, a drone looks about one way."""

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.registration.rig_camera import Array

_STRAIGHT = 0.7
"""Cosine of the turn up to which a path is straight."""


def straight_pieces(places: Array) -> NDArray[np.int64]:
    """The piece of each place [N, 3] by its number; -1 between pieces, which have three places or more."""
    steps = np.diff(places, axis=0)
    towards = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)
    pieces = np.full(len(places), -1)
    first = number = 0
    for step in range(1, len(steps) + 1):
        if step == len(steps) or towards[step - 1] @ towards[step] < _STRAIGHT:
            if step - first > 1:
                pieces[first : step + 1] = number
                number += 1
            first = step
    return pieces
