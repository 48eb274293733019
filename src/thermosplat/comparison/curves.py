"""Values over time in the page of a comparison: a table, and a curve of each place and measurement."""

import html
import math
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from thermosplat.comparison.over_time import Row
from thermosplat.pictures.line_plot import line_plot
from thermosplat.reporting.camera_facts import stated_times
from thermosplat.thermography.comparison_file import PICTURED

CURVES_STYLE = """
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(400px, 1fr)); gap: 1em; margin-top: 1em; }
svg { width: 100%; height: auto; font: 12px system-ui, sans-serif; } svg .title { font-weight: 600; }
svg .grid { stroke: #e5e7eb; }
"""
_DAY, _HOUR = 86400.0, 3600.0
_BETWEEN = "Between two dates a line is straight. Nothing is said of times before the first and after the last."


def taken_at(root: Path, spectrum: str) -> datetime | None:
    """The middle one of the times that the files of a capture's images state, by their camera's clock.

    Args:
        root: The capture.
        spectrum: The spectrum.

    Returns:
        The time; None where the files state none.
    """
    times = stated_times(root, spectrum)
    try:
        return datetime.fromisoformat(times[len(times) // 2]).replace(tzinfo=None) if times else None
    except ValueError:
        return None


def over_time_chapter(rows: Sequence[Row], names: Sequence[str], times: Sequence[datetime | None]) -> str:
    """The page's chapter on values at all dates.

    Args:
        rows: Places and measurements.
        names: Of the dates, in the order of the rows' values.
        times: When the dates were; None where it is not known.

    Returns:
        HTML; "" where there are no rows.
    """
    if not rows:
        return ""
    when = ["" if time is None else f"<br>{time:%Y-%m-%d %H:%M}" for time in times]
    head = "".join(f"<th>{html.escape(name)}{time}</th>" for name, time in zip(names, when, strict=True))
    lines = "".join(
        f"<tr><td>{html.escape(row.title)}</td>"
        + "".join(f"<td>{'-' if value is None else f'{value:.2f}'}</td>" for value in row.values)
        + "</tr>"
        for row in rows
    )
    table = f"<h2>Over time</h2><table><tr><th></th>{head}</tr>{lines}</table>"
    known = [time for time in times if time is not None]
    unknown = [name for name, time in zip(names, times, strict=True) if time is None]
    if unknown:
        return f"{table}<p>No curves: files of {html.escape(', '.join(unknown))} do not state when they were taken.</p>"
    if len(set(known)) < len(known):
        return f"{table}<p>No curves: files of two dates state the same time.</p>"
    curves = "".join(_curve(row, known) for row in rows[:PICTURED])
    return f'{table}<p>{_BETWEEN}</p><div class="plots">{curves}</div>'


def _curve(row: Row, times: Sequence[datetime]) -> str:
    """A row's values as dots, with lines between dates that follow one another and have both a value."""
    first = min(times)
    unit, name = (_HOUR, "hours") if (max(times) - first).total_seconds() < 2 * _DAY else (_DAY, "days")
    line = sorted(
        ((time - first).total_seconds() / unit, math.nan if value is None else value)
        for time, value in zip(times, row.values, strict=True)
    )
    return line_plot(row.title, {row.what: line}, across=f"{name} since {first:%Y-%m-%d %H:%M}", dots=True)
