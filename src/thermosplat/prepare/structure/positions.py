"""Where photographs were taken, as GPS has it: metres east, north and up of a point among them.

A photograph without a position takes the one of its thermal image. Positions without a height count in the plane.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.capture_folder import Exif, FrameRow

_LAST_LATITUDE = 84.0
"""[°] where UTM ends."""
_OF_RTK = {50: 0.05, 34: 0.5}
"""Standard deviation [m] by DJI's flag: "fixed" is good to centimetres, "float" to decimetres."""
_DEVIATIONS_APART = 4.0
"""Median distance from the middle, in standard deviations of a position, from which on neighbours by position are
neighbours: 12 m with GPS alone. Open choice."""
GPS_ALONE = 3.0
"""The same of a position of which nothing more is known. The GPS performance standard of 2020 promises 8 m for 95% of
the time, which is 4 m here, and receivers do better."""


@dataclass(frozen=True)
class Positions:
    """Positions of photographs.

    Args:
        origin: Latitude [°], longitude [°], altitude [m] of 0, 0, 0.
        places: East, north, up [m], [N, 3] in the photographs' order; NaN where nothing is known.
        deviations: Standard deviation of each [m], [N].
        has_height: Whether they have altitudes; without, up is 0.
    """

    origin: tuple[float, float, float]
    places: NDArray[np.float64]
    deviations: NDArray[np.float64]
    has_height: bool

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which photographs have one, [N]."""
        return np.asarray(np.isfinite(self.places).all(axis=1))

    @property
    def tell_neighbours(self) -> bool:
        """Whether they lie farther apart than they are wrong, as those of a flight do and those of a room do not."""
        places = self.places[self.known]
        if not len(places):
            return False
        reach = np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))
        return bool(reach > _DEVIATIONS_APART * np.median(self.deviations[self.known]))


def positions_of(photographs: Sequence[FrameRow], thermal: Mapping[str, FrameRow]) -> Positions:
    """The positions of photographs.

    Args:
        thermal: The thermal image of each paired one, by the photograph's file.
    """
    sources: list[Exif | None] = []
    for row in photographs:
        both = (row, thermal.get(row.file))
        sources.append(next((one for one in both if one is not None and _is_placed(one)), None))
    has_height = sum(one is not None and one.altitude is not None for one in sources) >= 0.5 * max(
        sum(one is not None for one in sources), 1
    )
    used = [one if one is not None and (one.altitude is not None or not has_height) else None for one in sources]
    degrees = np.array(
        [
            (math.nan,) * 3 if one is None else (one.latitude, one.longitude, one.altitude if has_height else 0.0)
            for one in used
        ],
        np.float64,
    ).reshape(-1, 3)
    known = np.isfinite(degrees).all(axis=1)
    places, origin = np.full_like(degrees, np.nan), (0.0, 0.0, 0.0)
    if known.any():
        latitude, longitude, altitude = np.median(degrees[known], axis=0).tolist()
        origin = (round(latitude, 7), round(longitude, 7), round(altitude, 2))
        places[known] = east_north_up(degrees[known], origin)
    return Positions(origin, places, np.array([_deviation(one) for one in used]), has_height)


def east_north_up(degrees: NDArray[np.float64], origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Metres east, north and up of a point on WGS 84.

    Args:
        degrees: Latitude [°], longitude [°], altitude [m], [N, 3].
        origin: The same of the point.
    """
    latitude, longitude, altitude = origin
    return np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu(degrees, latitude, longitude, altitude), np.float64)


def _is_placed(row: Exif) -> bool:
    return row.latitude is not None and row.longitude is not None and abs(row.latitude) <= _LAST_LATITUDE


def _deviation(row: Exif | None) -> float:
    if row is None:
        return math.nan
    stated = [value for value in (row.position_std, row.altitude_std) if value]
    if stated:
        return max(*stated, 0.01)  # a receiver that states 0 has not measured it
    return _OF_RTK.get(row.rtk_flag or 0, GPS_ALONE)
