"""Which palette a capture's pseudo-coloured images have, and whether they really have it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.flir_metadata import read_flir_palette
from thermosplat.spectra import BUILT_IN_PALETTES, SpectrumConfig, label
from thermosplat.thermal.radiometry import FLIR_IRON, GREY, Palette, load_palette

CAPTURE_PALETTE = "ironbow_lut.json"
"""File in a capture's folder with its own palette."""
_RESIDUAL_LIMIT = 15.0
"""Mean distance to a palette [8-bit levels] beyond which it is not the images'. Measured on RGBT-Scenes: 2 for thermal
images and the camera's own palette; 15 to 37 for most MSX images."""
_RESIDUAL_LIMIT_ASSUMED = 25.0
"""The same for the built-in palette, which is FLIR's at nine stops only: 4 to 9, and 24 for one mostly cold frame; a
matplotlib palette like magma is off by 31."""
_SAMPLED_FRAMES = 6
_BUILT_IN = dict(zip(BUILT_IN_PALETTES, (GREY, FLIR_IRON), strict=True))


@dataclass(frozen=True)
class ChosenPalette:
    """A palette, and whether someone stated it (the user, the capture, the camera) or it is only assumed."""

    palette: Palette
    stated: bool


def choose_palette(root: Path, spectrum: str, config: SpectrumConfig, files: Sequence[Path]) -> ChosenPalette:
    """The user's palette, else the capture's, else the one FLIR stored in the files, else FLIR Iron.

    Raises:
        UserError: A palette file cannot be used.
    """
    if config.palette is not None:
        return ChosenPalette(_BUILT_IN.get(config.palette) or load_palette(config.palette, spectrum), True)
    if (root / CAPTURE_PALETTE).is_file():
        return ChosenPalette(load_palette(root / CAPTURE_PALETTE, spectrum), True)
    stored = read_flir_palette(files[0]) if files else None
    return ChosenPalette(FLIR_IRON, False) if stored is None else ChosenPalette(stored, True)


def palette_notes(chosen: ChosenPalette, images: Sequence[NDArray[np.uint8]], spectrum: str) -> list[str]:
    """A warning (none or one) if pseudo-coloured images [H, W, 3] lie far from their palette."""
    step = max(1, len(images) // _SAMPLED_FRAMES)
    sampled = [chosen.palette.residual(image[::4, ::4] / np.float32(255)) for image in images[::step]]
    residual = float(np.mean(sampled)) if sampled else 0.0
    if residual <= (_RESIDUAL_LIMIT if chosen.stated else _RESIDUAL_LIMIT_ASSUMED):
        return []
    which = "the palette" if chosen.stated else "FLIR Iron"
    return [
        f"Colours of the {label(spectrum)} images lie {residual:.0f} of 255 levels off {which}: another palette, or an "
        f"overlay? Intensities are unreliable; give the right one with --{spectrum}.palette."
    ]
