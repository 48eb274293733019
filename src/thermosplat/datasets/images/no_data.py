"""Pixels without a value: those that a file calls NoData, and fill values that no sensor gives."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_CLOSE = 1e-6
"""Relative difference from NoData that counts as none: the tag is a text, and rounded."""
_NOT_MEASURED = 1e20
"""Size from which on a floating-point number is a fill value: ±3.4e38 (GIS), 9.97e36 (netCDF), 1e20 (CF)."""
_FILL_VALUES = (-9999.0, -32768.0, -32767.0)
"""Fill values that programs write without saying so, where all other values lie far above."""


def void_pixels(image: NDArray[Any], nodata: float | None) -> NDArray[np.bool_] | None:
    """Where an image has no value, bool [H, W]; None: it has one everywhere.

    Args:
        image: [H, W], or [H, W, 3], where all three have to be NoData.
        nodata: The value that the file calls NoData; None: it says nothing.
    """
    void: NDArray[np.bool_] = np.zeros(image.shape, np.bool_)
    if nodata is not None:
        void |= np.isnan(image) if np.isnan(nodata) else np.isclose(image, nodata, _CLOSE, 0.0)
    if image.ndim == 2 and image.dtype.kind == "f":
        void |= np.abs(image) >= _NOT_MEASURED
    if image.ndim == 2 and image.dtype.kind in "if":
        for value in _FILL_VALUES:
            filled = image == value
            if filled.any() and (image[~(filled | void)] > value / 2).all():
                void |= filled
    pixels = np.all(void.reshape(*image.shape[:2], -1), axis=-1)
    return pixels if pixels.any() else None
