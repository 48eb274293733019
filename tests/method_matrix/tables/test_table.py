"""One table in three notations."""

import csv
from pathlib import Path

from thermosplat.method_matrix.tables.table import Table, write_tables

TABLE = Table("t", "A title.", ("method", "PSNR", "MAE [°C]"), (("no_hybrid_rgb", "25.07 ± 0.10", "-"),))


def test_a_table_in_markdown() -> None:
    """Words to the left, numbers to the right."""
    assert TABLE.markdown().splitlines() == [
        "| method | PSNR | MAE [°C] |",
        "| :-- | --: | --: |",
        "| no_hybrid_rgb | 25.07 ± 0.10 | - |",
    ]


def test_a_table_in_csv() -> None:
    """Reads back as it was."""
    assert list(csv.reader(TABLE.csv().splitlines())) == [list(TABLE.columns), list(TABLE.rows[0])]


def test_a_table_in_latex() -> None:
    """What LaTeX would take as its own is escaped."""
    latex = TABLE.latex()
    assert r"\begin{tabular}{lrr}" in latex
    assert r"no\_hybrid\_rgb & 25.07 $\pm$ 0.10 & - \\" in latex
    assert r"MAE [$^\circ$C]" in latex


def test_files_of_tables(tmp_path: Path) -> None:
    """One Markdown file with all tables, a CSV and a LaTeX file each."""
    write_tables(tmp_path, [TABLE])
    assert {path.name for path in tmp_path.iterdir()} == {"tables.md", "t.csv", "t.tex"}
    assert (tmp_path / "tables.md").read_text().startswith("A title.\n\n| method")
