"""What a comparison leaves: a page, tables, pictures, a GeoTIFF and a mesh of the differences.

The page needs no script: its pictures of two dates lie on one another, and the upper one is drawn aside by its corner.
"""

import csv
import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat import __version__
from thermosplat.comparison.changes import Change, Changes
from thermosplat.comparison.curves import CURVES_STYLE
from thermosplat.comparison.dated_map import DatedMap
from thermosplat.comparison.over_time import Row
from thermosplat.export.formats.ply_tables import write_points
from thermosplat.export.maps.geotiff import write_geotiff
from thermosplat.export.maps.orthomosaic import MapGrid
from thermosplat.pictures.display_palettes import display_palette
from thermosplat.pictures.image_display import Image8, rgb_bytes, write_png
from thermosplat.runs.atomic_writes import write_text
from thermosplat.spectra import unit_label
from thermosplat.thermography.comparison_file import COMPARISON_FILE, PICTURED, change_picture, plan_picture

_POLICY = "default-src 'none'; img-src 'self' file:; style-src 'unsafe-inline'"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; } th, td { padding: .3em .8em; text-align: right; border-bottom: 1px solid #d1d5db; }
th:first-child, td:first-child { text-align: left; } img { max-width: 100%; }
.wipe { position: relative; overflow: hidden; } .wipe > img { display: block; width: 1000px; max-width: none; }
.wipe div { position: absolute; inset: 0 auto 0 0; width: 50%; overflow: hidden; resize: horizontal;
  border-right: 3px solid #fff; } .wipe div img { width: 1000px; max-width: none; display: block; }
"""
_AROUND = 40
"""Pixels around a change in its picture."""
_LARGEST_CROP = 900
_SPAN = (1.0, 99.0)
"""Percentiles of values at the ends of the palette."""


def write_difference(
    folder: Path, grid: MapGrid, maps: tuple[DatedMap, DatedMap], changes: Changes, unit: str, name: str
) -> list[Path]:
    """Write the difference of a date as GeoTIFF, and as a mesh whose vertices are the points of its pixels.

    Args:
        maps: The first and the later date.
    """
    tif, ply = folder / f"difference_{name}.tif", folder / f"difference_{name}.ply"
    bands = np.stack([changes.differences, changes.uncertainties]).astype(np.float32)
    write_geotiff(
        tif,
        bands,
        west=grid.west,
        north=grid.north,
        pixel=grid.pixel,
        crs=grid.frame.crs,
        names=["difference", "half of its 95% interval"],
        unit=unit,
        tags={"SOFTWARE": "thermosplat", "FRAME": grid.frame.note, "SHIFT": f"{changes.shift:.3f}"},
    )
    heights = maps[1].heights if maps[1].surface is None else maps[1].surface
    there = np.isfinite(changes.differences) & np.isfinite(heights)
    rows, columns = np.nonzero(there)
    places = np.column_stack([*_place(grid, rows, columns), heights[rows, columns]])
    origin = np.floor(places.mean(axis=0)) if len(places) else np.zeros(3)
    colours = _colours(changes.differences, *symmetric(changes), "blue red")[rows, columns]
    scalars = {
        "scalar_difference": changes.differences[rows, columns].astype(np.float32),
        "scalar_plus_minus": changes.uncertainties[rows, columns].astype(np.float32),
    }
    comment = f"origin {' '.join(map(repr, origin.tolist()))}: to be added to positions"
    write_points(ply, (places - origin).astype(np.float32), colours, scalars, [comment], faces=_faces(there))
    return [tif, ply]


def _faces(there: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Two triangles between four neighbouring pixels that are there, of the pixels that are, [F, 3]."""
    number = np.cumsum(there).reshape(there.shape) - 1
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    all_there = there[:-1, :-1] & there[:-1, 1:] & there[1:, :-1] & there[1:, 1:]
    halves = [np.stack(corners, axis=-1)[all_there] for corners in ((a, c, b), (b, c, d))]
    return np.concatenate(halves).astype(np.int32)


def entries(changes: Changes, grid: MapGrid) -> list[dict[str, Any]]:
    """The changes of a date as JSON and CSV have them."""
    found = []
    for number, one in enumerate(changes.found, 1):
        east, north = _place(grid, *map(np.array, one.middle))
        entry = {
            "number": number,
            "kind": one.kind,
            "east": float(east),
            "north": float(north),
            "area": float(one.mask.sum() * grid.pixel**2),
            "difference": round(one.difference, 4),
            "plus_minus": round(one.uncertainty, 4),
            "height": round(one.height, 4),
        }
        if one.source is not None:
            entry["from_east"], entry["from_north"] = map(float, _place(grid, *map(np.array, one.source)))
        found.append(entry)
    return found


def write_tables(folder: Path, content: dict[str, Any], rows: Sequence[Row], dates: Sequence[str]) -> None:
    """Write changes.json, changes.csv and over_time.csv."""
    table = io.StringIO()
    columns = ("date", "number", "kind", "east", "north", "area", "difference", "plus_minus", "height")
    writer = csv.DictWriter(table, (*columns, "from_east", "from_north"), restval="")
    writer.writeheader()
    for date in content["dates"]:
        writer.writerows({"date": date["name"], **entry} for entry in date["changes"])
    times = io.StringIO()
    csv.writer(times).writerows(
        [("what", *dates), *((row.what, *("" if v is None else v for v in row.values)) for row in rows)]
    )
    write_text(folder / "changes.csv", table.getvalue())
    write_text(folder / "over_time.csv", times.getvalue())
    write_text(folder / COMPARISON_FILE, json.dumps(content, indent=1) + "\n")


def write_page(
    folder: Path, maps: Sequence[DatedMap], changes: Sequence[Changes], content: dict[str, Any], last: str
) -> Path:
    """Write index.html and its pictures.

    Args:
        last: HTML of the chapter after those of the dates.
    """
    known = np.concatenate([one.values[np.isfinite(one.values)] for one in maps])
    low, high = np.percentile(known, _SPAN).tolist() if len(known) else (0.0, 1.0)
    pictures = folder / "pictures"
    for number, one in enumerate(maps):
        write_png(pictures / f"date_{number}.png", _colours(one.values, low, high, "iron"))
    parts = [f"<p>{html.escape(line)}</p>" for line in content["sentences"]]
    for later, (found, stated) in enumerate(zip(changes, content["dates"]), 1):
        spread = symmetric(found)
        write_png(folder / plan_picture(later), _plan(found, spread))
        parts.append(
            f"<h2>{html.escape(stated['name'])}</h2>"
            f"<p>{html.escape(stated['said'])} Drag the corner of the picture.</p>"
            f'<div class="wipe"><img src="pictures/date_{later}.png" alt="later"><div>'
            '<img src="pictures/date_0.png" alt="first"></div></div>'
            f"<p>Difference, blue {spread[0]:.1f} to red {spread[1]:+.1f}:</p>"
            f'<img src="{plan_picture(later)}" alt="differences">'
        )
        parts.append(_table(stated["changes"], content["unit"], content["length_unit"]))
        for number, change in enumerate(found.found[:PICTURED], 1):
            name = change_picture(later, number)
            write_png(folder / name, _both(change, maps[0], maps[later], (low, high)))
            parts.append(f'<h3>{number}, {change.kind}</h3><img src="{name}" alt="">')
    parts.append(last)
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f"<title>Comparison</title><style>{_STYLE}{CURVES_STYLE}</style></head><body><h1>Comparison</h1>\n"
        + "\n".join(parts)
        + f"<p>thermosplat {html.escape(__version__)}</p></body></html>\n"
    )
    write_text(folder / "index.html", page)
    return folder / "index.html"


def _plan(changes: Changes, spread: tuple[float, float]) -> Image8:
    """The differences from above, with the changes outlined and numbered."""
    picture = np.ascontiguousarray(_colours(changes.differences, *spread, "blue red"))
    for number, one in enumerate(changes.found, 1):
        contours, _ = cv2.findContours(one.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, contours, -1, (0, 0, 0), 1)
        row, column = one.middle
        cv2.putText(picture, str(number), (column + 6, row - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 2)
    return picture


def _table(stated: list[dict[str, Any]], unit: str, length: str) -> str:
    rows = "".join(
        f"<tr><td>{one['number']} {one['kind']}</td><td>{one['east']:.2f} {one['north']:.2f}</td>"
        f"<td>{one['area']:.3g}</td>"
        f"<td>{one['difference']:+.2f} ± {one['plus_minus']:.2f}</td><td>{one['height']:+.2f}</td></tr>"
        for one in stated
    )
    return (
        f"<table><tr><th>change</th><th>east, north [{length}]</th><th>area [{length}²]</th>"
        f"<th>difference [{html.escape(unit_label(unit))}]</th><th>height [{length}]</th></tr>{rows}</table>"
    )


def _both(change: Change, first: DatedMap, other: DatedMap, span: tuple[float, float]) -> Image8:
    """A change in the pictures of both dates: photographs above, values below; the first date on the left."""
    rows, columns = np.nonzero(change.mask)
    upper, left = max(0, rows.min() - _AROUND), max(0, columns.min() - _AROUND)
    part = (
        slice(upper, min(rows.max() + _AROUND, upper + _LARGEST_CROP)),
        slice(left, min(columns.max() + _AROUND, left + _LARGEST_CROP)),
    )
    lines = [np.concatenate([_colours(one.values[part], *span, "iron") for one in (first, other)], axis=1)]
    if first.photograph is not None and other.photograph is not None:
        shown = [rgb_bytes(np.nan_to_num(one.photograph[part])) for one in (first, other) if one.photograph is not None]
        lines.insert(0, np.concatenate(shown, axis=1))
    return np.concatenate(lines, axis=0)


def symmetric(changes: Changes) -> tuple[float, float]:
    """Differences at the ends of the palette."""
    known = np.abs(changes.differences[np.isfinite(changes.differences)])
    most = float(np.percentile(known, _SPAN[1])) if len(known) else 1.0
    return -max(most, 1e-6), max(most, 1e-6)


def _colours(values: NDArray[np.floating], low: float, high: float, palette: str) -> Image8:
    shown = display_palette(palette).to_color(np.nan_to_num(np.clip((values - low) / max(high - low, 1e-9), 0, 1)))
    return rgb_bytes(np.where(np.isfinite(values)[..., None], shown, 1.0))


def _place(grid: MapGrid, rows: NDArray[Any], columns: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """East and north of pixels' middles."""
    return grid.west + (columns + 0.5) * grid.pixel, grid.north - (rows + 0.5) * grid.pixel
