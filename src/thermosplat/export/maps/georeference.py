"""The frame of a map on the Earth: by geo.json of a capture, or of one without, by its cameras' GPS positions."""

import csv
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.colmap.similarity import ransac_similarity
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.regular_files import read_regular

TABLE = "frames.csv"
"""The table of images that thermosplat-prepare writes."""
_LEAST_CAMERAS = 4
_LEAST_SPREAD = 0.05
"""Second spread of the cameras' positions, of the first: from one straight line the turn about it cannot be found."""
_RANSAC_ERROR = 10.0
"""[m]; positions farther off are left out. Consumer GPS is good to a few metres."""


def gps_positions(capture: Capture, spectrum: str) -> dict[str, tuple[float, float, float]]:
    """Latitude [°], longitude [°] and altitude [m] by image file below ``images/<spectrum>/``; empty without a table.

    Args:
        capture: The capture; ``frames.csv`` lies in its folder.

    Raises:
        UserError: The table cannot be read.
    """
    path = capture.root / TABLE
    if not path.is_file():
        return {}
    found = {}
    try:
        with io.StringIO(read_regular(path).decode("utf-8-sig"), newline="") as file:
            for row in csv.DictReader(file):
                position = tuple(_number(row.get(name)) for name in ("latitude", "longitude", "altitude"))
                if row.get("spectrum") == spectrum and row.get("file") and all(map(math.isfinite, position)):
                    found[str(row["file"])] = position
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"Cannot read {path}: {error}.", "Make it again: thermosplat-prepare import.") from error
    return {
        file: (latitude, longitude, altitude)
        for file, (latitude, longitude, altitude) in found.items()
        if abs(latitude) <= 84 and abs(longitude) <= 180  # UTM ends at 84°
    }


def located_frame(geo: GeoFrame, placement: Placement) -> MapFrame:
    """The map frame of a capture that says where its world lies."""
    note = f"EPSG:{geo.epsg}; {geo.cameras} cameras lie {geo.residual:.2f} m from where GPS has them, in the median."
    offset = geo.to_utm(np.array(placement.origin))
    return MapFrame(geo.rotation, geo.scale * placement.unit, offset, f"EPSG:{geo.epsg}", note)


def georeferenced_frame(capture: Capture, spectrum: str) -> MapFrame | None:
    """The map frame in which the cameras lie where GPS has them: UTM on WGS 84, metres.

    Args:
        spectrum: Whose cameras are looked up in ``frames.csv``.

    Returns:
        None where the capture has too few positions, or they lie on one line.

    Raises:
        UserError: The table cannot be read, or no similarity fits the positions.
    """
    positions = gps_positions(capture, spectrum)
    if not positions:
        return None
    folder = capture.root / "images" / spectrum
    centres, places = [], []
    for frame in (*capture.train, *capture.test):
        view = frame.views.get(spectrum)
        place = None if view is None else positions.get(_below(view.path, folder))
        if view is not None and place is not None:
            centres.append(np.linalg.inv(view.viewmat)[:3, 3])
            places.append(place)
    if len(centres) < _LEAST_CAMERAS:
        return None
    crs, utm = utm_coordinates(np.array(places))
    spreads = np.linalg.svd(utm - utm.mean(axis=0), compute_uv=False)
    if spreads[1] < _LEAST_SPREAD * spreads[0]:
        return None
    return aligned_frame(np.array(centres), utm, crs)


def aligned_frame(centres: NDArray[np.float64], places: NDArray[np.float64], crs: str) -> MapFrame:
    """The similarity from camera centres to where they are on the map (pycolmap, LO-RANSAC).

    Args:
        centres: In the world, [V, 3].
        places: East, north, up [m], [V, 3].

    Raises:
        UserError: No similarity fits.
    """
    middle = places.mean(axis=0)  # RANSAC runs near zero, where float64 has digits to spare
    matrix = ransac_similarity(centres, places - middle, _RANSAC_ERROR)
    if matrix is None:
        raise UserError(
            f"The cameras' GPS positions in {TABLE} do not fit their poses.",
            "Is it the table of this capture? Remove latitude and longitude from it for a map in local units.",
        )
    matrix[:, 3] += middle
    frame = MapFrame.of_similarity(matrix, crs)
    error = np.linalg.norm(frame.to_map(centres) - places, axis=1)
    note = f"{len(centres)} cameras with GPS: {crs}, median distance {np.median(error):.2f} m."
    return replace(frame, note=note)


def utm_coordinates(places: NDArray[np.float64]) -> tuple[str, NDArray[np.float64]]:
    """The UTM zone of the mean longitude, and east, north [m] and altitude in it.

    Args:
        places: Latitude [°], longitude [°], altitude [m], [V, 3].

    Returns:
        The zone, such as "EPSG:32632", and coordinates [V, 3].
    """
    from thermosplat.export.maps.geotiff import rasterio_module

    latitude, longitude = places[:, 0].mean(), places[:, 1].mean()
    zone = min(int((longitude + 180) // 6) + 1, 60)
    crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
    warp = rasterio_module("rasterio.warp")
    east, north = warp.transform("EPSG:4326", crs, places[:, 1].tolist(), places[:, 0].tolist())
    return crs, np.stack([np.array(east), np.array(north), places[:, 2]], axis=1)


def _number(text: str | None) -> float:
    return float(text) if text and text.strip() else math.nan


def _below(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name
