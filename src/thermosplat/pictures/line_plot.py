"""Lines over steps or time as SVG, for pages that open without a network."""

import html
import math
from collections.abc import Mapping, Sequence
from itertools import groupby

from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.pictures.color_bar import tick_labels, tick_values

Line = Sequence[tuple[float, float]]
"""Points (x, y), x rising; y is NaN where the line is broken."""

WIDTH, HEIGHT = 480, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 24, 44, 40
_LETTER = 6.6
"""Width of a letter [px], on average."""
COLORS = ("#2563eb", "#dc2626", "#059669", "#d97706", "#7c3aed", "#0891b2")
"""Of the lines, in turns; distinct for most people with colour blindness."""
MOST_POINTS = 600
"""Of a line; a longer one is thinned out: a picture has no more pixels."""


def line_plot(title: str, lines: Mapping[str, Line], *, across: str = "step", dots: bool = False) -> str:
    """A plot as an ``<svg>`` element; every text in it is escaped.

    Args:
        lines: By name; those without points are left out.
        across: What x is.
        dots: Mark each point.

    Returns:
        SVG; "" where no line has a point.
    """
    lines = {name: line for name, line in lines.items() if any(math.isfinite(y) for _, y in line)}
    shown = {name: evenly_chosen(line, MOST_POINTS) for name, line in lines.items()}
    if not shown:
        return ""
    xs = [x for line in shown.values() for x, _ in line]
    ys = [y for line in shown.values() for _, y in line if math.isfinite(y)]
    x_low, x_high = _widened(min(xs), max(xs), 0.0)
    y_low, y_high = _widened(min(ys), max(ys), 0.05)

    def place(x: float, y: float) -> tuple[float, float]:
        across = _LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - _LEFT - _RIGHT)
        return across, HEIGHT - _BOTTOM - (y - y_low) / (y_high - y_low) * (HEIGHT - _TOP - _BOTTOM)

    parts = [f'<text class="title" x="{_LEFT}" y="18">{html.escape(title)}</text>']
    bottom = HEIGHT - _BOTTOM
    for values, is_x in ((tick_values(x_low, x_high), True), (tick_values(y_low, y_high), False)):
        for value, text in zip(values, tick_labels(values), strict=True):
            if is_x:
                x, _ = place(value, y_low)
                parts.append(f'<line class="grid" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom}"/>')
                parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{text}</text>')
            else:
                _, y = place(x_low, value)
                parts.append(f'<line class="grid" x1="{_LEFT}" y1="{y:.1f}" x2="{WIDTH - _RIGHT}" y2="{y:.1f}"/>')
                parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.1f}" y="{HEIGHT - 6}" text-anchor="middle">{html.escape(across)}</text>')
    key = float(_LEFT)
    for index, (name, line) in enumerate(shown.items()):
        color = COLORS[index % len(COLORS)]
        for piece in _pieces(line):
            places = [place(*point) for point in piece]
            if len(piece) > 1:
                points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
                parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"/>')
            if len(piece) == 1 or dots:
                parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in places]
        if len(shown) > 1:
            parts.append(f'<text x="{key:.1f}" y="36" style="fill:{color}">{html.escape(name)}</text>')
            key += _LETTER * (len(name) + 2)
    label = html.escape(title, quote=True)
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _pieces(line: Line) -> list[Line]:
    """The parts of a line between its breaks."""
    groups = groupby(line, key=lambda point: math.isfinite(point[1]))
    return [list(points) for finite, points in groups if finite]


def _widened(low: float, high: float, share: float) -> tuple[float, float]:
    margin = share * (high - low) if high > low else max(abs(low), 1.0) * 0.5
    return low - margin, high + margin
