"""A table as Markdown, CSV and LaTeX."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from thermosplat.runs.atomic_writes import write_text

_LATEX_SPECIAL = str.maketrans({"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "°": r"$^\circ$", "±": r"$\pm$"})


@dataclass(frozen=True)
class Table:
    """Text in rows and columns; the first columns say what a row is, the others hold numbers."""

    name: str
    title: str
    """One sentence: what it shows."""
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    """As many entries as columns each."""
    labels: int = 1
    """How many of the first columns are words."""

    def markdown(self) -> str:
        """The table as Markdown, numbers to the right."""
        marks = [":--"] * self.labels + ["--:"] * (len(self.columns) - self.labels)
        lines = [self.columns, tuple(marks), *self.rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"

    def csv(self) -> str:
        """The table as CSV."""
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows([self.columns, *self.rows])
        return file.getvalue()

    def latex(self) -> str:
        """The table as a LaTeX tabular with booktabs' rules."""
        shape = "l" * self.labels + "r" * (len(self.columns) - self.labels)
        cells = [[text.translate(_LATEX_SPECIAL) for text in line] for line in (self.columns, *self.rows)]
        lines = [" & ".join(line) + r" \\" for line in cells]
        body = "\n".join(lines[1:])
        return (
            f"% {self.title}\n\\begin{{tabular}}{{{shape}}}\n\\toprule\n{lines[0]}\n\\midrule\n{body}\n"
            "\\bottomrule\n\\end{tabular}\n"
        )


def write_tables(out: Path, tables: list[Table]) -> None:
    """Write tables.md with all tables, and a .csv and a .tex file for each; all atomically."""
    text = "\n".join(f"{table.title}\n\n{table.markdown()}" for table in tables)
    write_text(out / "tables.md", text)
    for table in tables:
        _write_table(out, table)


def write_own_table(out: Path, table: Table) -> None:
    """Write a table that is too long for tables.md: its own .md, .csv and .tex file; all atomically."""
    write_text(out / f"{table.name}.md", f"{table.title}\n\n{table.markdown()}")
    _write_table(out, table)


def _write_table(out: Path, table: Table) -> None:
    write_text(out / f"{table.name}.csv", table.csv())
    write_text(out / f"{table.name}.tex", table.latex())
