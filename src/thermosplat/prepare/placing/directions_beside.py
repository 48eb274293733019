"""Whether an image looks the way that images taken just before and after it look."""

from collections.abc import Mapping

import numpy as np

from thermosplat.prepare.registration.rig_camera import Array

BESIDE = 3
"""Images before and after one that are beside it."""


def turned_from_beside(rotations: Mapping[int, Array]) -> dict[int, float]:
    """Smallest angle of each image to one of those beside it [°]; 0 where there is none.

    Args:
        rotations: World to camera [3, 3], by the image's number in the order in which they were taken.
    """
    found = {}
    for number, rotation in rotations.items():
        near = [other for at, other in rotations.items() if 0 < abs(at - number) <= BESIDE]
        cosines = [(np.trace(rotation @ other.T) - 1) / 2 for other in near]
        found[number] = float(np.degrees(np.arccos(np.clip(max(cosines, default=1.0), -1.0, 1.0))))
    return found
