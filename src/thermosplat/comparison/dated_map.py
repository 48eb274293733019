"""What a date's scene shows on a common grid seen from above: values with their intervals, heights, a photograph."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.evaluation.loaded_run import LoadedRun
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.export.maps.orthomosaic import MapGrid
from thermosplat.scene.rendered_frame import LEAST_COVER
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermography.certainty import FEW_VIEWS, NO_SURFACE

Array = NDArray[np.float32]
_PART = 256
"""Side of the parts [px] whose training views are looked for together: those of the middle see the whole part."""


@dataclass(frozen=True, eq=False)
class Date:
    """A scene of one date, and where it lies in the first."""

    name: str
    """What to call it."""
    run: LoadedRun
    capture: Capture
    to_first: MapFrame
    """From its scene to that of the first date."""


@dataclass(frozen=True, eq=False)
class DatedMap:
    """A date on the grid. Each array is [H, W] and NaN where the scene shows nothing."""

    values: Array
    half_widths: Array
    """Half of their 95% intervals."""
    heights: Array
    """Height of the spectrum's own surface [map units]. Shadows that moved do not change it, as they do that of
    photographs."""
    photograph: NDArray[np.float32] | None
    """Colours in [0, 1], [H, W, 3]; None where the run has none."""
    surface: Array | None = None
    """Heights, and those of the photographs' surface where that of the spectrum is not known; None: ``heights``."""
    drift: float = 0.0
    """Standard deviation of the level of its thermal images, which their camera sets."""


@torch.no_grad()
def dated_map(date: Date, grid: MapGrid, spectrum: str, photographs: str | None) -> DatedMap:
    """Render a date.

    A cold surface may be as dark as what lies behind the scene, and training leaves it transparent there. Then values
    count where photographs have a surface, and no height is known. What fewer than two thermal images saw, as at the
    edge of a flight, counts nowhere.

    Args:
        grid: The grid, in the frame of the first date's scene.
        photographs: The spectrum of the photographs; None: there is none.
    """
    own, run = replace(grid, frame=grid.frame.of(date.to_first)), date.run
    certainty, scale = run.certainties(date.capture)[spectrum], run.scales[spectrum]
    leading = photographs or spectrum
    values, half_widths, heights, surface = (np.full((grid.height, grid.width), np.nan, np.float32) for _ in range(4))
    seen = np.full((grid.height, grid.width, 3), np.nan, np.float32)
    for part, *place in _parts(own):
        at, view = tuple(place), part.view(0, 0, part.width, part.height, run.device)
        rendered = run.model.render(dict.fromkeys((spectrum, leading), view), sh_degree=run.sh_degree)
        depth = run.model.render_depth(spectrum, view).cpu().numpy()
        solid = rendered.alphas[spectrum][..., 0].cpu().numpy() >= LEAST_COVER
        there = rendered.covered().cpu().numpy()
        shown = scale.value(pixel_intensity(rendered.images[spectrum].clamp(0, 1), scale)).cpu().numpy()
        heights[at] = np.where(solid & (depth > 0), part.top - depth * own.frame.scale, np.nan)
        below = run.model.render_depth(leading, view).cpu().numpy()
        photographed = np.where(below > 0, part.top - below * own.frame.scale, np.nan)
        surface[at] = np.where(np.isfinite(heights[at]), heights[at], photographed)
        if there.any():
            sure = certainty.of_view(view, np.where(there, shown, np.nan))
            read = there & (sure.doubts & (FEW_VIEWS | NO_SURFACE) == 0)
            values[at] = np.where(read, shown, np.nan)
            half_widths[at] = np.where(read, sure.half_width, np.nan)
        if photographs is not None:
            colours = rendered.images[leading].clamp(0, 1).cpu().numpy()
            seen[at] = np.where(there[..., None], colours, np.nan)
    drift, shown = certainty.calibration.level, None if photographs is None else seen
    return DatedMap(values, half_widths, heights, shown, surface, drift)


def _parts(grid: MapGrid) -> Iterator[tuple[MapGrid, slice, slice]]:
    """Parts of a grid, each seen from above its own middle."""
    for upper in range(0, grid.height, _PART):
        for left in range(0, grid.width, _PART):
            height, width = min(_PART, grid.height - upper), min(_PART, grid.width - left)
            west, north = grid.west + left * grid.pixel, grid.north - upper * grid.pixel
            part = replace(grid, west=west, north=north, width=width, height=height)
            yield part, slice(upper, upper + height), slice(left, left + width)
