"""Which cells of a matrix are left to make, and in which order."""

from pathlib import Path

import pytest

from made_cells import made_cell
from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import CellResult
from thermosplat.method_matrix.cells import Cell, Scene, settings
from thermosplat.method_matrix.matrix import Matrix

METHODS = ("3dgs", "mmone", "thermosplat")


def matrix(tmp_path: Path, max_steps: int = 100) -> Matrix:
    scenes = [Scene("desk", "desk"), Scene("lab", "lab")]
    return Matrix(tmp_path, scenes, {method: method for method in METHODS}, max_steps=max_steps)


def finished(of: Matrix, *cells: Cell, minutes: float = 1.0) -> dict[Cell, CellResult]:
    return {
        cell: made_cell(
            cell.scene, cell.method, cell.seed, steps=100, train_minutes=minutes, settings=settings(of.config(cell))
        )
        for cell in cells
    }


def test_finished_cells_are_not_missing(tmp_path: Path) -> None:
    """Wherever they were made; with other settings they do not count, and that is said."""
    cells = matrix(tmp_path).cells()
    done = finished(matrix(tmp_path), cells[0], cells[4])
    assert matrix(tmp_path).missing(done) == [cells[1], cells[2], cells[3], cells[5]]
    with pytest.raises(UserError, match=r"desk / 3dgs / seed 42 is finished with max_steps=100, now 200"):
        matrix(tmp_path, max_steps=200).missing(done)


def test_longest_cells_come_first(tmp_path: Path) -> None:
    """By the time of a step of the method's finished cells, else of all; equal ones stay in order."""
    of = matrix(tmp_path)
    left = [Cell("desk", method, 42) for method in METHODS]
    slow = finished(of, Cell("lab", "mmone", 42), minutes=9.0)
    fast = finished(of, Cell("lab", "3dgs", 42), minutes=1.0)
    assert [cell.method for cell in of.longest_first(left, slow | fast)] == ["mmone", "thermosplat", "3dgs"]
    steps = [of.config(cell).max_steps for cell in of.longest_first(left, {})]
    assert steps == sorted(steps, reverse=True)
    same = [Cell("lab", "3dgs", 42), Cell("desk", "3dgs", 42)]
    assert of.longest_first(same, {}) == same
