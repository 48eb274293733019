"""Some of many, evenly chosen."""

import numpy as np


def evenly_chosen(count: int, most: int) -> list[int]:
    """Up to ``most`` of the numbers from 0 to ``count`` - 1, in order; both ends are among two or more."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()
