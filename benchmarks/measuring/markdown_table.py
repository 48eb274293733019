"""Measured rows as a Markdown table."""

from collections.abc import Mapping, Sequence
from typing import Any


def markdown_table(rows: Sequence[Mapping[str, Any]], forms: Mapping[str, str]) -> str:
    """A table with a line for each row; what a row lacks is left empty.

    Args:
        rows: What was measured.
        forms: By column, which is a key of the rows, how its numbers are written, such as "{:.1%}".
    """
    lines = ["| " + " | ".join(forms) + " |", "|---" * len(forms) + "|"]
    for row in rows:
        cells = [form.format(row[key]) if key in row else "" for key, form in forms.items()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
