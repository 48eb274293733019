"""How a camera moves while it reads an image line by line."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LineMotion:
    """Motion from the first line of an image to its last; the pose is that at the middle."""

    velocity: Array
    """Of the camera's centre [m per readout], [3]."""
    turn: Array
    """About the centre, as a rotation vector in the world [rad per readout], [3]."""
    height: int
    """Lines of the image."""
    focal: float
    cy: float
    k1: float
    k2: float
    """The lens, which says in which line a ray ends."""


def motions(poses: list[Array], share: float) -> list[tuple[Array, Array]]:
    """Velocity and turn during the readout, from the poses before and after.

    Args:
        poses: Camera to world, each [4, 4].
        share: Of the time between two frames that the readout takes.
    """
    found = []
    for k in range(len(poses)):
        before, after = poses[max(k - 1, 0)], poses[min(k + 1, len(poses) - 1)]
        frames = min(k + 1, len(poses) - 1) - max(k - 1, 0)
        turn = cv2.Rodrigues(after[:3, :3] @ before[:3, :3].T)[0].ravel()
        found.append(((after[:3, 3] - before[:3, 3]) * share / max(frames, 1), turn * share / max(frames, 1)))
    return found
