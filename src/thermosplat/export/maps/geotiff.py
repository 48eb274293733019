"""Maps as GeoTIFF in floating point, by rasterio (extra "maps")."""

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import write_atomically


def rasterio_module(name: str = "rasterio") -> ModuleType:
    """A module of rasterio.

    Raises:
        UserError: rasterio is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            "Maps are written by rasterio, which is not installed.",
            'Install it: pip install ".[maps]" in the repository.',
        ) from error


def write_geotiff(
    path: Path,
    bands: NDArray[np.float32],
    *,
    west: float,
    north: float,
    pixel: float,
    crs: str | None,
    names: Sequence[str],
    unit: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write a float32 cloud-optimised GeoTIFF, compressed without loss; pixels without data are NaN.

    Args:
        path: The file, ``*.tif``.
        bands: [B, H, W], the first row in the north.
        west: Coordinate of the left edge of the first pixel.
        north: Coordinate of its upper edge.
        pixel: Side of a pixel, in the unit of the coordinates.
        crs: Coordinate system; None: local coordinates.
    """
    rasterio = rasterio_module()
    transform = rasterio.transform.from_origin(west, north, pixel, pixel)
    count, height, width = bands.shape

    def write(temporary: Path) -> None:
        with rasterio.open(
            temporary,
            "w",
            driver="COG",  # tiles, and smaller copies for a view from afar
            width=width,
            height=height,
            count=count,
            dtype="float32",
            crs=crs,
            transform=transform,
            nodata=float("nan"),
            compress="deflate",
            predictor="yes",
            overview_resampling="average",
        ) as file:
            file.write(bands)
            file.update_tags(**(tags or {}))
            for band, name in enumerate(names, 1):
                file.set_band_description(band, name)
                if unit is not None:
                    file.set_band_unit(band, unit)

    write_atomically(path, write)
