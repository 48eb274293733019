"""All finished cells of a matrix, also those that other machines made."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import (
    FILE_NAME,
    FORMAT,
    CellResult,
    read_cell,
    read_json,
    result_from,
    write_json,
)
from thermosplat.method_matrix.cells import Cell, difference
from thermosplat.method_matrix.tables.paper_numbers import METHODS, SCENES, paper_scene
from thermosplat.runs.atomic_writes import write_text
from thermosplat.spectra import MAE

RESULTS = "results.json"
PER_VIEW = "per_view.csv"


class Results:
    """Finished cells and where their run folders are.

    Attributes:
        cells: Results by cell.
        folders: Run folder of each cell that has one here.
    """

    def __init__(self) -> None:
        self.cells: dict[Cell, CellResult] = {}
        self.folders: dict[Cell, Path] = {}
        self._sources: dict[Cell, Path] = {}

    @classmethod
    def collect(cls, out: Path, merged: Iterable[Path] = ()) -> "Results":
        """The finished cells of a matrix, and those that were made elsewhere.

        Args:
            out: The matrix's folder: its run folders count, not the results.json that was made from them.
            merged: Folders with run folders at any depth, with results.json files in place of run folders that were
                left behind, or such files themselves. What several have is taken from the first.

        Raises:
            UserError: A folder is missing, a file is damaged, or two cells of one name were made with other settings.
        """
        results = cls()
        results._add_run_folders(out)
        for folder in merged:
            if not folder.exists():
                raise UserError(f"There is no {folder} to merge.", "Give the --out folder of another machine's run.")
            has_folder = results._add_run_folders(folder)
            for path in [folder] if folder.is_file() else sorted(folder.rglob(RESULTS)):
                for values in _cells_of(path):
                    result = result_from(values, path)
                    if result.cell not in has_folder:
                        results.add(result, path)
        return results

    def _add_run_folders(self, folder: Path) -> set[Cell]:
        """Add the cells of all run folders in a folder; which they are."""
        added = set()
        for path in sorted(folder.rglob(FILE_NAME)):
            result = read_cell(path)
            self.add(result, path, path.parent)
            added.add(result.cell)
        return added

    def add(self, result: CellResult, source: Path, folder: Path | None = None) -> None:
        """Add a cell, unless it is there already.

        Raises:
            UserError: It is there with other settings.
        """
        cell = result.cell
        if cell not in self.cells:
            self.cells[cell], self._sources[cell] = result, source
        elif differing := difference(self.cells[cell].settings, result.settings):
            raise UserError(
                f"{cell} was made with other settings in {source} than in {self._sources[cell]}: {differing}.",
                "Merge folders of one matrix only.",
            )
        if folder is not None:
            self.folders.setdefault(cell, folder)

    def write(self, out: Path) -> None:
        """Write results.json and per_view.csv."""
        ordered = sorted(self.cells.values(), key=lambda result: (result.scene, result.method, result.seed))
        write_json(out / RESULTS, {"format": FORMAT, "cells": [{"format": FORMAT, **asdict(cell)} for cell in ordered]})
        _write_per_view(out / PER_VIEW, ordered)

    def scenes(self) -> list[str]:
        """Names of the scenes, the paper's in its order, then the others by name."""
        ranks = {scene: rank for rank, scene in enumerate(SCENES)}
        names = {cell.scene for cell in self.cells}
        return sorted(names, key=lambda name: (ranks.get(paper_scene(name) or "", len(ranks)), name))

    def methods(self) -> list[str]:
        """Names of the methods, the paper's in its order, then the others by name."""
        ranks = {method: rank for rank, method in enumerate(METHODS)}
        return sorted({cell.method for cell in self.cells}, key=lambda name: (ranks.get(name, len(ranks)), name))

    def spectra(self) -> list[str]:
        """Names of the spectra of all cells, in the order of the cells that have most of them."""
        by_number = sorted(self.cells.values(), key=lambda result: -len(result.spectra))
        return list(dict.fromkeys(name for result in by_number for name in result.spectra))

    def measured(self) -> dict[str, list[str]]:
        """By spectrum, the names of the errors of measured values that some cell has: "mae_<unit>"."""
        return {
            spectrum: list(
                dict.fromkeys(
                    name
                    for result in self.cells.values()
                    for name, value in (result.spectra.get(spectrum) or {}).items()
                    if name.startswith(MAE) and value is not None
                )
            )
            for spectrum in self.spectra()
        }

    def of(self, scene: str, method: str) -> list[CellResult]:
        """The cells of a scene and a method, one a seed."""
        found = [cell for cell in self.cells if (cell.scene, cell.method) == (scene, method)]
        return [self.cells[cell] for cell in sorted(found, key=lambda cell: cell.seed)]


def _cells_of(path: Path) -> list[object]:
    values = read_json(path)
    cells = values.get("cells") if isinstance(values, dict) else None
    if not isinstance(cells, list):
        raise UserError(f"{path} is not a results.json of thermosplat-benchmark.", "Delete it, or give another folder.")
    return cells


def _write_per_view(path: Path, results: Sequence[CellResult]) -> None:
    metrics = dict.fromkeys(key for result in results for row in result.per_view for key in row)
    columns = list(dict.fromkeys(["scene", "method", "seed", "frame", "spectrum", *metrics]))
    table = io.StringIO()
    writer = csv.DictWriter(table, columns)
    writer.writeheader()
    for result in results:
        named = {"scene": result.scene, "method": result.method, "seed": result.seed}
        writer.writerows(named | row for row in result.per_view)
    write_text(path, table.getvalue())
