"""Points as LAS 1.4, by laspy (extra "maps"): what QGIS, CloudCompare and surveyors' programs open."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.export.maps.geotiff import rasterio_module
from thermosplat.runs.atomic_writes import write_atomically

_STEP = 0.001
"""Coordinates are whole numbers of so many metres or world units: a millimetre."""
_RGB_FORMAT = 7
"""Point format of LAS 1.4 with colours."""


def check_laspy() -> None:
    """Say that laspy is missing before anything is rendered.

    Raises:
        UserError: It is not installed.
    """
    try:
        import laspy  # noqa: F401
    except ImportError as error:
        raise UserError(
            "LAS files are written by laspy, which is not installed.",
            'Install it: pip install ".[maps]" in the repository. Or take --format points, which needs nothing.',
        ) from error


def write_las(
    path: Path,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
    scalars: Mapping[str, NDArray[np.float32]],
    epsg: int | None,
) -> None:
    """Write coloured points with values as further dimensions.

    Args:
        path: The file, ``*.las``.
        points: Coordinates [m in the coordinate system, else world units], [M, 3].
        colors: 8-bit RGB, [M, 3].
        scalars: Values by name, [M] each.
        epsg: Coordinate system; None: local coordinates.

    Raises:
        UserError: laspy or rasterio, which knows coordinate systems, is not installed.
    """
    check_laspy()
    import laspy

    header = laspy.LasHeader(point_format=_RGB_FORMAT, version="1.4")
    header.generating_software = "thermosplat"
    header.offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    span = float(np.abs(points - header.offsets).max()) if len(points) else 1.0
    header.scales = np.full(3, max(_STEP, span / 2**30))  # 32-bit whole numbers hold them
    header.add_extra_dims([laspy.ExtraBytesParams(name[:32], np.float32) for name in scalars])
    if epsg is not None:
        wkt = rasterio_module("rasterio.crs").CRS.from_epsg(epsg).to_wkt()
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = (colors.astype(np.uint16) * 257).T
    for name, values in scalars.items():
        cloud[name[:32]] = values
    write_atomically(path, lambda temporary: cloud.write(str(temporary)))
