"""Regions of a scene that are hotter, or colder, than a threshold: a list with place, extent and extreme.

Every view gives the points of its pixels beyond the threshold. Points in the same or in neighbouring cells of a grid
are one region, whichever views they come from. Its surface is that of the view that sees the most of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FEWEST_PIXELS = 4
"""Of a region in the view that sees the most of it: fewer are noise."""
_NEIGHBOURS = np.array([(x, y, z) for x in (0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)])
"""Half of the 26 cells around a cell; the other half has it as its neighbour."""


@dataclass(frozen=True, eq=False)
class HotPixels:
    """Pixels beyond the threshold in one view."""

    points: Array
    """Their points of the scene, [P, 3], in the world."""
    values: Array
    """[P]."""
    areas: Array
    """Surface of each [world units²], [P]."""


@dataclass(frozen=True)
class Region:
    """A part of the scene beyond the threshold."""

    place: tuple[float, float, float]
    """Its middle, in the world."""
    size: tuple[float, float, float]
    """Sides of the box around it, along the world's axes [world units]."""
    extreme: float
    """Its largest value, or its least where colder ones were looked for."""
    extreme_place: tuple[float, float, float]
    """Where that is."""
    area: float
    """Its surface [world units²]."""
    views: int
    """Views that see it."""
    best_view: int
    """Number of the view that sees the most of it."""
    pixels: int
    """In that view."""


def find_regions(views: list[HotPixels], cell: float, *, colder: bool = False) -> list[Region]:
    """The regions, the most extreme first.

    Args:
        views: Pixels beyond the threshold, view by view.
        cell: Side of a cell of the grid [world units], > 0.
        colder: They are below the threshold.
    """
    counts = [len(view.values) for view in views]
    if not sum(counts):
        return []
    points = np.concatenate([view.points for view in views])
    values = np.concatenate([view.values for view in views])
    areas = np.concatenate([view.areas for view in views])
    of_view = np.repeat(np.arange(len(views)), counts)
    cells, of_cell = np.unique(cells_of(points, cell), axis=0, return_inverse=True)
    region = _connected(cells)[of_cell.ravel()]
    found = []
    order = np.argsort(region, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(region[order])) + 1):
        per_view = np.bincount(of_view[mine], minlength=len(views))
        best = int(per_view.argmax())
        if per_view[best] < FEWEST_PIXELS:
            continue
        extreme = mine[values[mine].argmin() if colder else values[mine].argmax()]
        low, high = points[mine].min(axis=0), points[mine].max(axis=0)
        found.append(
            Region(
                place=_point(points[mine].mean(axis=0)),
                size=_point(high - low),
                extreme=float(values[extreme]),
                extreme_place=_point(points[extreme]),
                area=float(max(np.bincount(of_view[mine], areas[mine]))),
                views=int((per_view > 0).sum()),
                best_view=best,
                pixels=int(per_view[best]),
            )
        )
    return sorted(found, key=lambda one: one.extreme, reverse=not colder)


def cells_of(points: Array, side: float) -> NDArray[np.int64]:
    """The cell of each point in a grid, counted from the least, [N, 3].

    Cells begin at the origin: one point far away moves no other's.

    Args:
        points: At least one, [N, 3].
        side: Of a cell, > 0.
    """
    cells = np.floor(points / side).astype(np.int64)
    return np.asarray(cells - cells.min(axis=0))


def _connected(cells: NDArray[np.int64]) -> NDArray[np.intp]:
    """A number for each cell [C, 3], the same for cells that neighbours connect."""
    spans = cells.max(axis=0) + 3
    keys = ((cells[:, 0] + 1) * spans[1] + cells[:, 1] + 1) * spans[2] + cells[:, 2] + 1
    order = np.argsort(keys)
    ordered = keys[order]
    pairs = []
    for x, y, z in _NEIGHBOURS:
        asked = keys + (x * spans[1] + y) * spans[2] + z
        at = np.minimum(np.searchsorted(ordered, asked), len(ordered) - 1)
        there = ordered[at] == asked
        pairs.append(np.stack([np.flatnonzero(there), order[at[there]]], axis=1))
    label = np.arange(len(cells))
    edges = np.concatenate(pairs)
    while len(edges):  # of what an edge joins, the greater root comes under the lesser, and all under their roots
        one, other = label[edges].T
        np.minimum.at(label, np.maximum(one, other), np.minimum(one, other))
        while (label != (above := label[label])).any():
            label = above
        edges = edges[label[edges[:, 0]] != label[edges[:, 1]]]
    return label


def _point(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
