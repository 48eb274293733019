"""A comparison of several dates, from scenes in one frame to a page with tables and maps."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermosplat.comparison.changes import SEASON, Changes, find_changes
from thermosplat.comparison.curves import over_time_chapter, taken_at
from thermosplat.comparison.dated_map import Date, dated_map
from thermosplat.comparison.files import entries, symmetric, write_difference, write_page, write_tables
from thermosplat.comparison.over_time import over_time
from thermosplat.export.maps.georeference import located_frame
from thermosplat.export.maps.geotiff import rasterio_module
from thermosplat.export.maps.map_frame import camera_centers, local_frame, map_extent
from thermosplat.export.maps.orthomosaic import MapGrid
from thermosplat.spectra import unit_label
from thermosplat.thermography.comparison_file import VERSION, WHAT

_PIXELS = 1500
"""Along the longer side of the grid, at most where nobody says how large a pixel is."""


def compare(
    dates: Sequence[Date],
    spectrum: str,
    photographs: str | None,
    folder: Path,
    *,
    pixel: float | None = None,
    extent: tuple[float, float, float, float] | None = None,
    sentences: Sequence[str] = (),
) -> list[str]:
    """Compare all later dates with the first, and write what was found.

    Args:
        photographs: The spectrum of the photographs; None: there is none.
        pixel: Side of a pixel [map units]; None: that of the images from the middle distance, or a 1500th of the
            longer side if that is larger.
        extent: West, south, east, north; None: what the first capture saw.
        sentences: What was said of the frame, for the page.

    Raises:
        UserError: The extent is impossible, rasterio is missing, or a file cannot be written.
    """
    rasterio_module()  # to say that it is missing before anything is rendered
    grid = _grid(dates[0], spectrum, photographs or spectrum, pixel, extent)
    maps = [dated_map(date, grid, spectrum, photographs) for date in dates]
    changes = [find_changes(maps[0], later, grid.pixel) for later in maps[1:]]
    unit, length = str(dates[0].run.scales[spectrum].measured_unit), "m" if grid.frame.crs else "units"
    said, files, stated = [], [], list[dict[str, Any]]()
    for date, later, found in zip(dates[1:], maps[1:], changes):
        line = changes_said(date.name, dates[0].name, found, unit)
        said.append(line)
        offset = np.zeros(3) if date.to_first.offset is None else date.to_first.offset
        to_first = np.column_stack([date.to_first.scale * date.to_first.rotation, offset])
        stated.append(
            {
                "name": date.name,
                "run": str(date.run.directory.path.resolve()),
                "said": line,
                "shift": found.shift,
                "shift_plus_minus": found.shift_uncertainty,
                "span": symmetric(found)[1],
                "to_first": to_first.tolist(),
                "changes": entries(found, grid),
            }
        )
        name = re.sub(r"[^\w.-]+", "_", date.name)
        files += write_difference(folder, grid, (maps[0], later), found, unit, name)
    names, times = [date.name for date in dates], [taken_at(date.capture.root, spectrum) for date in dates]
    rows = over_time(dates, maps, changes, unit_label(unit))
    content = {
        "format": f"thermosplat-{WHAT}",
        "version": VERSION,
        "run": str(dates[0].run.directory.path.resolve()),
        "first": dates[0].name,
        "spectrum": spectrum,
        "unit": unit,
        "length_unit": length,
        "crs": grid.frame.crs,
        "pixel": grid.pixel,
        "sentences": list(sentences),
        "times": [None if time is None else time.isoformat() for time in times],
        "dates": stated,
    }
    write_tables(folder, content, rows, names)
    page = write_page(folder, maps, changes, content, over_time_chapter(rows, names, times))
    return [*said, f"Look at {page}; {', '.join(map(str, files))}"]


def _grid(
    first: Date, spectrum: str, leading: str, pixel: float | None, extent: tuple[float, float, float, float] | None
) -> MapGrid:
    """The grid in the frame of the first date's scene."""
    capture, geo = first.capture, first.run.geo or first.capture.geo
    frame = local_frame(capture, leading) if geo is None else located_frame(geo, capture.placement)
    west, south, east, north = extent = extent or map_extent(frame, capture)
    if pixel is None:
        middle = np.median(frame.to_map(capture.points), axis=0)
        away = np.linalg.norm(frame.to_map(camera_centers(capture, spectrum)[0]) - middle, axis=1)
        focal = np.median([one.views[spectrum].camera.fx for one in capture.train if spectrum in one.views])
        pixel = max(max(east - west, north - south) / _PIXELS, float(np.median(away) / focal))
    return MapGrid.over(frame, capture, leading, extent=extent, pixel=pixel)


def changes_said(name: str, first: str, changes: Changes, unit: str) -> str:
    """What changed from the first date to another one, in a sentence or two."""
    counts = Counter(one.kind for one in changes.found)
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "none"
    season = (
        f" {changes.things_share:.0%} of the surface has another height: leaves or snow may hide what changed."
        if changes.things_share > SEASON
        else ""
    )
    return (
        f"From {first} to {name} all values changed by {changes.shift:+.2f} ± {changes.shift_uncertainty:.2f} "
        f"{unit_label(unit)}: weather, and the levels of both cameras. "
        f"Beyond that, places that changed: {listed}.{season}"
    )
