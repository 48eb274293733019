"""Where a capture lies on the Earth: ``geo.json`` in its folder, which thermosplat-prepare writes.

The world of such a capture is in metres: x east, y north, z up, from a point on WGS 84. A similarity brings it to UTM,
the frame of maps. Files of float32 cannot hold UTM's coordinates, so what is exported counts from a whole-metre origin
in UTM, the same for all files of a capture: ``utm = exported + origin``.

UTM is flat and the Earth is not: a kilometre from the point the two differ by 8 cm in height. Lengths on the map, and
heights with them, are ``scale`` times those of the world, 0.999 to 1.001.
"""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular

GEO_FILE = "geo.json"
_STEP = 100.0
"""[m] over which the turn and the scale between the world and UTM are measured."""
_LARGEST = 1e8
"""[m]; nothing on the Earth has larger coordinates."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GeoFrame:
    """The world of a capture on the Earth.

    Args:
        latitude: Of the world's origin [°].
        longitude: The same [°].
        altitude: The same [m], above what GPS counts from.
        residual: Median distance [m] of cameras from their GPS positions.
        cameras: How many cameras that is of.
    """

    latitude: float
    longitude: float
    altitude: float
    residual: float
    cameras: int

    @property
    def epsg(self) -> int:
        """Number of the UTM zone's coordinate system."""
        return (32600 if self.latitude >= 0 else 32700) + self._origin_and_axes[2]

    @property
    def zone(self) -> str:
        """The UTM zone, such as "32N"."""
        return f"{self.epsg % 100}{'N' if self.latitude >= 0 else 'S'}"

    @property
    def rotation(self) -> Array:
        """[3, 3] from the world's axes to the map's east, north and up."""
        (x, y), scale = self._origin_and_axes[1], self.scale
        return np.array([[x / scale, -y / scale, 0.0], [y / scale, x / scale, 0.0], [0.0, 0.0, 1.0]])

    @property
    def scale(self) -> float:
        """Metres on the map per metre of the world."""
        return float(np.linalg.norm(self._origin_and_axes[1]))

    @property
    def offset(self) -> Array:
        """The world's origin in UTM: east, north, altitude [m]."""
        return self._origin_and_axes[0]

    @property
    def origin(self) -> Array:
        """What is to be added to exported positions for UTM [m], [3]: whole metres."""
        return np.round(self.offset)

    def to_utm(self, points: NDArray[np.floating]) -> Array:
        """UTM coordinates of points of the world, both [..., 3]."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.offset

    @cached_property
    def _origin_and_axes(self) -> tuple[Array, Array, int]:
        """The world's origin in UTM, a metre along its x there, and the zone."""
        import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
        import pycolmap

        transform = pycolmap.GPSTransform()
        here = (self.latitude, self.longitude, self.altitude)
        side = 1.0 if self.latitude >= 0 else -1.0  # a metre from the equator, where UTM's northings begin anew
        ends = np.array([[-_STEP, side, 0], [_STEP, side, 0]])
        degrees = np.vstack([[here], transform.enu_to_ellipsoid(ends, *here)])
        places, zone = transform.ellipsoid_to_utm(degrees)  # all in one zone
        origin, west, east = places
        return origin, (east - west)[:2] / (2 * _STEP), int(zone)

    def content(self) -> dict[str, Any]:
        """What ``geo.json`` says."""
        to_utm = np.eye(4)
        to_utm[:3, :3], to_utm[:3, 3] = self.scale * self.rotation, self.offset
        return {
            "about": "the capture's poses are in metres: x east, y north, z up of a point on WGS 84",
            "latitude": self.latitude,
            "longitude": self.longitude,
            "altitude": self.altitude,
            "epsg": self.epsg,
            "utm_zone": self.zone,
            "utm_from_world": to_utm.tolist(),
            "world_from_utm": np.linalg.inv(to_utm).tolist(),
            "residual_metres": self.residual,
            "cameras": self.cameras,
        }


def read_geo(folder: Path) -> GeoFrame | None:
    """What ``geo.json`` in a folder says; None where there is none.

    Raises:
        UserError: It is damaged.
    """
    path = folder / GEO_FILE
    if not path.exists():
        return None
    try:
        content = json.loads(read_regular(path))
        latitude, longitude, altitude, residual = (
            float(content[key]) for key in ("latitude", "longitude", "altitude", "residual_metres")
        )
        cameras = int(content["cameras"])
        if not (abs(latitude) <= 84 and abs(longitude) <= 180):  # nor is either NaN
            raise ValueError("it names no place on the Earth where UTM is defined")
        if not (abs(altitude) <= _LARGEST and 0 <= residual <= _LARGEST and cameras >= 0):
            raise ValueError("it has numbers that nothing on the Earth has")
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}).",
            "Make it again with thermosplat-prepare sfm, or remove it for results in world units.",
        ) from error
    return GeoFrame(latitude, longitude, altitude, residual, cameras)
