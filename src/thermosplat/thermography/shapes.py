"""Shapes of measurements in a picture: which pixels they cover, and their outlines. Places are in pixels."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Shape = Literal["spot", "line", "rectangle", "ellipse", "polygon"]
SHAPES: tuple[Shape, ...] = get_args(Shape)
AREAS: tuple[Shape, ...] = ("rectangle", "ellipse", "polygon")
LETTERS: dict[Shape, str] = {"spot": "S", "line": "L", "rectangle": "R", "ellipse": "E", "polygon": "P"}
"""What names of measurements begin with."""
MOST_POINTS = 64
"""Corners of a polygon."""
Place = tuple[float, float]
Indices = tuple[NDArray[np.intp], NDArray[np.intp]]
_ARC = 16
"""Corners of an ellipse's outline."""


def number_of_points(shape: Shape) -> tuple[int, int]:
    """Fewest and most places that a shape has: one, two ends, two opposite corners of its frame, or its corners."""
    return {"spot": (1, 1), "polygon": (3, MOST_POINTS)}.get(shape, (2, 2))


def covered(shape: Shape, places: Sequence[Place], width: int, height: int) -> Indices:
    """Rows and columns of the pixels that a shape covers, of a line in its order.

    Args:
        shape: Which.
        places: Its places [px]; those outside of the picture are moved to its edge.
        width: Of the picture [px].
        height: Of the picture [px].
    """
    size = np.array([width, height])
    exact = np.clip(np.asarray(places, np.float64), 0, size)
    at = np.clip(np.floor(exact), 0, size - 1).astype(np.intp)
    if shape == "spot":
        return at[:1, 1], at[:1, 0]
    if shape == "line":
        count = int(np.abs(at[1] - at[0]).max()) + 1
        columns, rows = (np.rint(np.linspace(at[0, k], at[1, k], count)).astype(np.intp) for k in (0, 1))
        return rows, columns
    (left, top), (right, bottom) = at.min(axis=0), at.max(axis=0)
    rows, columns = (index.ravel() for index in np.mgrid[top : bottom + 1, left : right + 1])
    if shape == "rectangle":
        return rows, columns
    x, y = columns + 0.5, rows + 0.5
    if shape == "ellipse":
        middle, half = (exact[0] + exact[1]) / 2, np.maximum(np.abs(exact[1] - exact[0]) / 2, 0.5)
        inside = ((x - middle[0]) / half[0]) ** 2 + ((y - middle[1]) / half[1]) ** 2 <= 1
    else:
        inside = _inside(x, y, exact)
    if not inside.any():  # less than a pixel: the one that it lies in
        inside = (rows == (top + bottom) // 2) & (columns == (left + right) // 2)
    return rows[inside], columns[inside]


def outline(shape: Shape, places: Sequence[Place]) -> list[Place]:
    """Corners of a shape's outline, in their order."""
    if shape in ("spot", "line", "polygon"):
        return [(float(x), float(y)) for x, y in places]
    (x0, y0), (x1, y1) = places
    if shape == "rectangle":
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    angles = 2 * np.pi * np.arange(_ARC) / _ARC
    xs, ys = (x0 + x1) / 2 + (x1 - x0) / 2 * np.cos(angles), (y0 + y1) / 2 + (y1 - y0) / 2 * np.sin(angles)
    return [(float(x), float(y)) for x, y in zip(xs, ys, strict=True)]


def _inside(x: NDArray[np.float64], y: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points lie in a polygon: those whose ray to the right passes its edges an odd number of times."""
    odd = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            passes = (y0 > y) != (y1 > y)
            odd ^= passes & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return odd
