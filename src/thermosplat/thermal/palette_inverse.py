"""The inverse of a palette: the point of its curve of colours that is nearest to a colour.

The same lines compute with numpy's arrays and, on a GPU, with torch's tensors: what they call has one name and one
meaning in both. The curve has n entries and is linear between them.
"""

from types import ModuleType
from typing import Any, NamedTuple

TABLE_SIZE = 32
"""Cells along each colour axis of the table that starts the inverse: 8 levels of 8 bits each."""
_WINDOW = 1 / 64
"""Share of the curve to either side of the table's answer within which the inverse looks for the nearest segment."""


class Curve(NamedTuple):
    """A palette as its inverse reads it: arrays of numpy, or tensors of torch on one device."""

    starts: Any
    """First colour of each segment, channels first, float32 [3, n-1]."""
    directions: Any
    """From the first colour of each segment to its last, float32 [3, n-1]."""
    squared_lengths: Any
    """Of the directions, not zero, float32 [n-1]."""
    table: Any
    """Nearest segment of each cell's centre, int64 [TABLE_SIZE³], blue running fastest."""


def nearest_points(colors: Any, curve: Curve, xp: ModuleType) -> tuple[Any, Any]:
    """Project colours onto the segments around the one that the table names for each.

    Args:
        colors: Channels first, each contiguous, float32 [3, m]; any value.
        curve: The palette, of the same kind of arrays.
        xp: Their module, ``numpy`` or ``torch``.

    Returns:
        Where along the curve the nearest point is, in [0, 1], and its distance from the colour, both float32 [m].
    """
    red, green, blue = colors
    (red0, green0, blue0), (red1, green1, blue1), squared_lengths, table = curve
    last = len(squared_lengths) - 1
    cell = xp.clip(xp.asarray(colors * TABLE_SIZE, dtype=xp.int64), 0, TABLE_SIZE - 1)
    centre = table.take((cell[0] * TABLE_SIZE + cell[1]) * TABLE_SIZE + cell[2])
    best = xp.full_like(red, xp.inf)
    position = xp.zeros_like(red, dtype=xp.float64)
    window = 1 + int(_WINDOW * (last + 2))
    for offset in range(-window, window + 1):
        segment = xp.clip(centre + offset, 0, last)
        # a channel at a time, several times faster than rows of three; from the segment's start to the colour
        x, y, z = red - red0.take(segment), green - green0.take(segment), blue - blue0.take(segment)
        dx, dy, dz = red1.take(segment), green1.take(segment), blue1.take(segment)
        along = xp.clip((x * dx + y * dy + z * dz) / squared_lengths.take(segment), 0, 1)
        x -= along * dx
        y -= along * dy
        z -= along * dz
        squared = x * x + y * y + z * z
        closer = squared < best
        best = xp.where(closer, squared, best)
        position = xp.where(closer, segment + xp.asarray(along, dtype=xp.float64), position)
    return xp.asarray(position / (last + 1), dtype=xp.float32), xp.sqrt(best)
