"""What a date's scene shows on a common grid seen from above: values with their intervals, heights, a photograph."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.evaluation.loaded_run import LoadedRun
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.export.maps.orthomosaic import MapGrid, render_map

Array = NDArray[np.float32]
_PART = 256
"""Side of the parts [px] whose training views are looked for together: those of the middle see the whole part."""


@dataclass(frozen=True, eq=False)
class Date:
    """A scene of one date, and where it lies in the first."""

    name: str
    """What to call it."""
    run: LoadedRun
    """The trained scene."""
    capture: Capture
    """Its capture."""
    to_first: MapFrame
    """From its scene to that of the first date."""


@dataclass(frozen=True, eq=False)
class DatedMap:
    """A date on the grid. Each array is [H, W] and NaN where the scene shows nothing."""

    values: Array
    """Measured values."""
    half_widths: Array
    """Half of their 95% intervals."""
    heights: Array
    """Height of what is seen [map units]."""
    photograph: NDArray[np.float32] | None
    """Colours in [0, 1], [H, W, 3]; None where the run has none."""


@torch.no_grad()
def dated_map(date: Date, grid: MapGrid, spectrum: str, photographs: str | None) -> DatedMap:
    """Render a date.

    Args:
        date: The date.
        grid: The grid, in the frame of the first date's scene.
        spectrum: Whose values are compared.
        photographs: The spectrum of the photographs; None: there is none.
    """
    own = replace(grid, frame=grid.frame.of(date.to_first))
    run = date.run
    picture = render_map(run.model, spectrum, run.scales[spectrum], own, sh_degree=run.sh_degree)
    values = picture[0]
    certainty = run.certainties(date.capture)[spectrum]
    heights, half_widths = np.full_like(values, np.nan), np.full_like(values, np.nan)
    for part, rows, columns in _parts(own):
        view = part.view(0, 0, part.width, part.height, run.device)
        shown = values[rows, columns]
        depth = run.model.render_depth(spectrum, view).cpu().numpy()
        there = np.isfinite(shown) & (depth > 0)
        heights[rows, columns] = np.where(there, part.top - depth * own.frame.scale, np.nan)
        if there.any():
            half_widths[rows, columns] = np.where(there, certainty.of_view(view, shown).half_width, np.nan)
    seen = None
    if photographs is not None:
        colours = render_map(run.model, photographs, run.scales[photographs], own, sh_degree=run.sh_degree)
        seen = colours.transpose(1, 2, 0)
    return DatedMap(np.where(np.isfinite(heights), values, np.nan), half_widths, heights, seen)


def _parts(grid: MapGrid) -> Iterator[tuple[MapGrid, slice, slice]]:
    """Parts of a grid, each seen from above its own middle."""
    for upper in range(0, grid.height, _PART):
        for left in range(0, grid.width, _PART):
            height, width = min(_PART, grid.height - upper), min(_PART, grid.width - left)
            west, north = grid.west + left * grid.pixel, grid.north - upper * grid.pixel
            part = replace(grid, west=west, north=north, width=width, height=height)
            yield part, slice(upper, upper + height), slice(left, left + width)
