"""Positions of images in tables beside them: CSV files with names, latitude and longitude, and ODM's geo.txt.

Columns are found by their names, as exiftool, Metashape, Pix4D and drones' programs write them. A table is for the
images in its own folder and below; a position in a table counts more than one in the image itself.
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath

from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.source_files import SourceFile

_COLUMNS = {
    "name": frozenset(["name", "file", "filename", "image", "imagename", "label", "photo", "sourcefile"]),
    "latitude": frozenset(["latitude", "lat", "gpslatitude", "ylatitude"]),
    "longitude": frozenset(["longitude", "lon", "lng", "long", "gpslongitude", "xlongitude"]),
    "altitude": frozenset(["altitude", "alt", "gpsaltitude", "zaltitude", "elevation", "ele", "height"]),
}
"""Names of columns without anything but letters."""
_LARGEST = 1 << 26
"""Bytes of a table that is read."""
_NUMBER = r"\d+(?:\.\d+)?"


@dataclass(frozen=True)
class _Position:
    latitude: float
    longitude: float
    altitude: float | None


def with_tables(files: Sequence[SourceFile], root: Path) -> tuple[list[SourceFile], list[str]]:
    """Images with the positions that tables below a folder state.

    Returns:
        The images in the same order, and what was found.
    """
    placed, sentences = list(files), []
    tables = [path for path in root.rglob("*") if path.suffix.lower() == ".csv" or path.name.lower() == "geo.txt"]
    for path in sorted(tables):
        if not path.is_file() or path.stat().st_size > _LARGEST:
            continue
        name = path.relative_to(root).as_posix()
        positions, wrong = _read(path)
        named = _named(positions, [file for file in files if path.parent in file.path.parents])
        placed = [_at(file, named[file.path]) if file.path in named else file for file in placed]
        if named:
            what = agreeing(len(named), "position", "positions")
            sentences.append(f"{name} states the {what} of {counted(len(named), 'image')}.")
        if wrong and (named or positions):
            sentences.append(f"{counted(len(wrong), 'line')} of {name} without a position (first: {wrong[0]}).")
    return placed, sentences


def _named(positions: Mapping[str, _Position], files: Sequence[SourceFile]) -> dict[Path, _Position]:
    """The positions by file: by their names, or by these without endings if no ending fits."""
    for key in (lambda name: name, lambda name: PurePosixPath(name).stem):
        wanted = {key(name): position for name, position in positions.items()}
        found = {file.path: wanted[name] for file in files if (name := key(file.path.name.lower())) in wanted}
        if found:
            return found
    return {}


def _at(file: SourceFile, position: _Position) -> SourceFile:
    """The file with a position, of whose exactness nothing is known."""
    exif = replace(file.exif, **vars(position), position_std=None, altitude_std=None, rtk_flag=None)
    return replace(file, exif=exif)


def _read(path: Path) -> tuple[dict[str, _Position], list[str]]:
    """Positions by the file's name in small letters, and lines that hold none; nothing of a table of something else."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError:
        return {}, []
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        return {}, []
    if lines[0].upper().replace(" ", "").startswith(("EPSG:4326", "WGS84")):  # ODM: name, longitude, latitude, altitude
        rows = [line.replace(",", " ").split() for line in lines[1:]]
        places = {"name": 0, "longitude": 1, "latitude": 2, "altitude": 3}
    else:
        separator = max(",;\t", key=lines[0].count)
        rows = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=separator))
        if separator == ";":
            rows = [[cell.replace(",", ".") for cell in row] for row in rows]
        heads = [re.sub("[^a-z]", "", head.lower()) for head in rows[0]]
        places = {}
        for what, known in _COLUMNS.items():
            column = next((number for number, head in enumerate(heads) if head in known), None)
            if column is not None:
                places[what] = column
        rows = rows[1:]
    if not {"name", "latitude", "longitude"} <= set(places):
        return {}, []
    found: dict[str, _Position] = {}
    wrong = []
    for row in rows:
        cells = {what: row[column] for what, column in places.items() if column < len(row)}
        latitude, longitude = _angle(cells.get("latitude", ""), 90), _angle(cells.get("longitude", ""), 180)
        if latitude is None or longitude is None or (latitude, longitude) == (0, 0):
            wrong.append(" ".join(row)[:60])
            continue
        name = PureWindowsPath(cells["name"].strip()).name.lower()  # takes both kinds of slashes
        found[name] = _Position(latitude, longitude, _height(cells.get("altitude", "")))
    return found, wrong


def _angle(text: str, most: float) -> float | None:
    """An angle [°]: a number, or degrees, minutes and seconds with the side, as exiftool writes them."""
    parts = [float(part) for part in re.findall(_NUMBER, text)]
    if not 1 <= len(parts) <= 3 or re.search(r"\d[eE][+-]?\d", text):
        return None
    value = sum(part / 60**place for place, part in enumerate(parts))
    side = text.strip()[-1:].upper()
    negative = text.strip().startswith("-") or side in ("S", "W")
    return None if value > most else -value if negative else value


def _height(text: str) -> float | None:
    number = re.search(rf"-?{_NUMBER}", text)
    if number is None:
        return None
    return -abs(float(number[0])) if "below" in text.lower() else float(number[0])
