"""A function of 8-bit colours, computed once for each small cell of colours that occur.

The pseudo-colours of a capture lie near one curve: of 16.8 million colours its images have some hundred thousand. A
cell is a cube of 4x4x4 levels. Sorting an image's colours to compute each once takes twenty times as long.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_INNER_BITS = 2
"""Of a level, those that tell colours of one cell apart. Cells of 8x8x8 colours take twice as long to fill."""
_CELL_BITS = 8 - _INNER_BITS
_IN_CELL = 1 << 3 * _INNER_BITS
_AT_ONCE = 1 << 16
"""Pixels looked up at once, so that what is computed on the way stays in the cache."""


class _Cells(NamedTuple):
    """The cells that were computed."""

    rows: NDArray[np.int32]
    """Row of each cell's values, red running slowest; -1: not computed yet."""
    values: NDArray[np.float32]
    """[cells, _IN_CELL]."""


class LevelTable:
    """What a function gives for colours.

    Several threads may look up at once: what one adds may be lost when another adds, and is then computed again.

    Args:
        function: From uint8 [n, 3] to float32 [n], each by its own colour alone.
    """

    def __init__(self, function: Callable[[NDArray[np.uint8]], NDArray[np.float32]]) -> None:
        self._function = function
        empty = np.full(1 << 3 * _CELL_BITS, -1, np.int32)
        self._cells = _Cells(empty, np.empty((0, _IN_CELL), np.float32))

    def __call__(self, levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The function's value for each colour.

        Args:
            levels: uint8 [..., 3].

        Returns:
            float32 [...].
        """
        flat = levels.reshape(-1, 3)
        found = np.empty(len(flat), np.float32)
        for start in range(0, len(flat), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            found[part] = self._looked_up(flat[part])
        return found.reshape(levels.shape[:-1])

    def _looked_up(self, levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        channels = np.ascontiguousarray(levels.T).astype(np.int32)
        cell, inner = _joined(channels >> _INNER_BITS, _CELL_BITS), _joined(channels & 3, _INNER_BITS)
        cells = self._cells
        rows = cells.rows.take(cell)
        if len(rows) and rows.min() < 0:
            cells = self._cells = self._with(cells, np.flatnonzero(np.bincount(cell[rows < 0])))
            rows = cells.rows.take(cell)
        return cells.values.reshape(-1).take(rows.astype(np.int64) * _IN_CELL + inner)

    def _with(self, cells: _Cells, new: NDArray[np.intp]) -> _Cells:
        """The cells and new ones."""
        lowest = _taken_apart(new, _CELL_BITS) << _INNER_BITS
        levels = lowest[:, None] + _taken_apart(np.arange(_IN_CELL), _INNER_BITS)[None]
        values = self._function(levels.reshape(-1, 3).astype(np.uint8)).reshape(len(new), _IN_CELL)
        rows = cells.rows.copy()
        rows[new] = len(cells.values) + np.arange(len(new), dtype=np.int32)
        return _Cells(rows, np.concatenate([cells.values, values]))


def _joined(channels: NDArray[np.int32], bits: int) -> NDArray[np.int32]:
    """One number of three of so many bits each, red foremost."""
    return (channels[0] << 2 * bits) | (channels[1] << bits) | channels[2]


def _taken_apart(numbers: NDArray[np.intp], bits: int) -> NDArray[np.intp]:
    """The three numbers that ``_joined`` made one of, [..., 3]."""
    lowest = (1 << bits) - 1
    return np.stack([numbers >> 2 * bits, numbers >> bits & lowest, numbers & lowest], -1)
