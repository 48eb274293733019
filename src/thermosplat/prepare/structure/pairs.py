"""Which photographs are matched with one another: all of a few, else neighbours in space, in time and in looks.

What is matched grows with the number of photographs and not with its square. Where positions are known, neighbours are
looked for on all sides: photographs along a strip are closer to each other than strips are, and the nearest alone would
leave strips without a link.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

ALL_PAIRS_UP_TO = 120
"""Photographs without positions of which all are matched with all."""
FEW = 40
"""The same with positions: 780 pairs cost two minutes of a processor, and no position can be wrong."""
NEAREST = 10
"""Nearest photographs with which each is matched. As the next four, an open choice: 101 rendered photographs of a
flight keep the exactness of all pairs (benchmarks/records/prepare.md)."""
SIDES, OF_EACH_SIDE = 8, 2
"""Sectors about each photograph, and the nearest photographs in each that come after these."""
ALIKE_BESIDE_POSITIONS = 3
"""Photographs that look most alike, beside those by position: what brings those home whose position is wrong."""
ALIKE, NEXT_BY_NAME = 20, 8
"""Photographs that look most alike, and that follow by name, of photographs without a position."""

Pairs = set[tuple[int, int]]
Likeness = Callable[[], NDArray[np.float32]]


def chosen_pairs(positions: NDArray[np.float64], likeness: Likeness) -> list[tuple[int, int]]:
    """Which photographs are matched.

    Args:
        positions: East, north, up [m] by photograph in the order of their names, [N, 3]; NaN where they are not known.
        likeness: How alike photographs look, [N, N]; it is asked for only where it is needed.

    Returns:
        Pairs (i, j) of places in that order, i < j, sorted.
    """
    count = len(positions)
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if count <= (FEW if len(known) else ALL_PAIRS_UP_TO):
        return list(combinations(range(count), 2))
    unknown = np.setdiff1d(np.arange(count), known)
    pairs = {(int(known[i]), int(known[j])) for i, j in _near(positions[known])}
    alike = likeness()
    pairs |= _most_alike(alike, known, ALIKE_BESIDE_POSITIONS) | _most_alike(alike, unknown, ALIKE)
    pairs |= {(i, j) for i in unknown.tolist() for j in range(i - NEXT_BY_NAME, i + NEXT_BY_NAME + 1)}
    return sorted({(min(i, j), max(i, j)) for i, j in pairs if i != j and min(i, j) >= 0 and max(i, j) < count})


def _near(positions: NDArray[np.float64]) -> Pairs:
    """Neighbours of each position: the nearest, and the nearest on every side in the plane in which positions lie."""
    if len(positions) < 2:
        return set()
    centred = positions - np.median(positions, axis=0)
    plane = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    pairs: Pairs = set()
    for i in range(len(positions)):
        order = np.argsort(np.linalg.norm(positions - positions[i], axis=1), kind="stable")
        order = order[order != i]
        chosen = set(order[:NEAREST].tolist())
        rest = order[NEAREST:]
        x, y = (plane[rest] - plane[i]).T
        sides = ((np.arctan2(y, x) / (2 * np.pi) + 1.0) * SIDES).astype(int) % SIDES
        for side in range(SIDES):
            chosen |= set(rest[sides == side][:OF_EACH_SIDE].tolist())
        pairs |= {(i, j) for j in chosen}
    return pairs


def _most_alike(likeness: NDArray[np.float32], of: NDArray[np.intp], count: int) -> Pairs:
    pairs: Pairs = set()
    for i in of.tolist():
        row = likeness[i].copy()
        row[i] = -np.inf
        pairs |= {(i, j) for j in np.argsort(-row, kind="stable")[:count].tolist()}
    return pairs
