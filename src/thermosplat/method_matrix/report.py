"""Everything that a matrix shows: results.json, tables, per-view numbers and comparison sheets."""

from collections.abc import Iterable
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.sheets import write_sheets
from thermosplat.method_matrix.tables.margins import margins_table
from thermosplat.method_matrix.tables.paired import paired_table
from thermosplat.method_matrix.tables.paper import all_tables
from thermosplat.method_matrix.tables.regions import region_table
from thermosplat.method_matrix.tables.table import Table, write_own_table, write_tables


def write_report(out: Path, merged: Iterable[Path] = ()) -> list[Table]:
    """Write the report of all finished cells.

    Returns:
        The tables of tables.md.

    Raises:
        UserError: There is no finished cell, or what is there does not fit together.
    """
    out.mkdir(parents=True, exist_ok=True)
    results = Results.collect(out, merged)
    if not results.cells:
        message = f"{out} has no finished cell yet."
        raise UserError(message, "Name scenes to train: thermosplat-benchmark SCENES --out FOLDER.")
    results.write(out)
    tables = [*all_tables(results), *(table for table in (margins_table(results), paired_table(results)) if table.rows)]
    write_tables(out, tables)
    regions = region_table(results)
    if regions is not None:
        write_own_table(out, regions)
    for scene in results.scenes():
        first_seed = {cell.method: folder for cell, folder in reversed(results.folders.items()) if cell.scene == scene}
        write_sheets(out, scene, {method: first_seed[method] for method in results.methods() if method in first_seed})
    return tables
