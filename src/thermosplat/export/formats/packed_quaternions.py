"""Quaternions by their three smallest components: the largest follows from the length 1, up to a sign that is free."""

import numpy as np
from numpy.typing import NDArray


def smallest_three(quats: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """The parts that formats store.

    Args:
        quats: Quaternions of length 1, [M, 4], in any order of components.

    Returns:
        Index of the component with the largest magnitude, [M], and the other three in their order, [M, 3], of the
        quaternion whose largest component is positive. Each lies in [-√½, √½].
    """
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    positive = quats * np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return largest, np.take_along_axis(positive, others[largest], axis=1)
