"""Hatching: diagonal lines over the part of a picture whose values are not to be taken like the rest."""

import numpy as np
from numpy.typing import NDArray

from thermosplat.pictures.image_display import Image8

_PERIOD, _WIDTH = 8, 2
"""Of the lines, along a row [px]."""


def hatched(picture: Image8, where: NDArray[np.bool_]) -> Image8:
    """A picture with lines over a part of it; elsewhere as it was.

    Args:
        picture: 8-bit RGB, [H, W, 3].
        where: The part, [H, W].
    """
    if not where.any():
        return picture
    rows, columns = np.indices(where.shape, np.int32)
    phase = (rows + columns) % _PERIOD
    marked = picture.copy()
    marked[where & (phase < _WIDTH)] = 235
    marked[where & (phase >= _WIDTH) & (phase < 2 * _WIDTH)] = 20  # seen on white, too
    return marked
