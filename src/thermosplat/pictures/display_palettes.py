"""Palettes by name, to show values with: those of thermal cameras, those of plots, and one for differences."""

from functools import cache

import cv2
import numpy as np

from thermosplat.errors import UserError
from thermosplat.thermal.radiometry import FLIR_IRON, GREY, Palette

_OPENCV = {
    "viridis": cv2.COLORMAP_VIRIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "plasma": cv2.COLORMAP_PLASMA,
    "magma": cv2.COLORMAP_MAGMA,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "turbo": cv2.COLORMAP_TURBO,
    "rainbow": cv2.COLORMAP_JET,
}
_OWN = {
    "iron": FLIR_IRON,
    "white hot": GREY,
    "black hot": Palette(GREY.colors[::-1]),
    "blue red": Palette(np.array([(0.1, 0.25, 0.75), (0.93, 0.93, 0.93), (0.75, 0.1, 0.1)], np.float32)),
}
DISPLAY_PALETTES = (*_OWN, *_OPENCV)
"""Names that ``display_palette`` takes. "iron" is FLIR's, between nine stops; "blue red" is for differences."""


@cache
def display_palette(name: str) -> Palette:
    """A palette by its name.

    Args:
        name: One of ``DISPLAY_PALETTES``.

    Raises:
        UserError: There is no such palette.
    """
    if name in _OWN:
        return _OWN[name]
    if name not in _OPENCV:
        raise UserError(f'There is no palette "{name}".', f"The palettes are {', '.join(DISPLAY_PALETTES)}.")
    levels = np.arange(256, dtype=np.uint8)[:, None]
    return Palette(cv2.applyColorMap(levels, _OPENCV[name])[:, 0, ::-1].astype(np.float32) / 255)
