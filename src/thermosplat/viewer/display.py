"""Layers as pictures: palette, range, isotherms, threshold; and two of them in one, by wipe or blend."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.pictures.display_palettes import display_palette
from thermosplat.pictures.hatching import hatched
from thermosplat.pictures.image_display import Image8, resized, rgb_bytes
from thermosplat.thermal.radiometry import Palette
from thermosplat.viewer.layers import LayerImage

RangeMode = Literal["capture", "automatic", "locked"]
Comparison = Literal["off", "wipe", "blend"]
OWN_PALETTE = "capture"
"""The palette that comes with a layer: of thermal images the capture's."""
_PERCENTILES = (1.0, 99.0)
"""Of the picture's values, at the ends of an automatic range: a few outliers do not flatten the rest."""
_NOTHING = np.array((24, 24, 28), np.uint8)
"""Colour of pixels without a value."""


@dataclass(frozen=True)
class Display:
    """How values are shown."""

    palette: str = OWN_PALETTE
    """"capture", or one of ``DISPLAY_PALETTES``."""
    range_mode: RangeMode = "capture"
    """Values at the palette's ends: the capture's (the layer's own), those of the picture, or locked ones."""
    locked: tuple[float, float] = (0.0, 1.0)
    """The locked ones, in the layer's unit."""
    isotherms: float = 0.0
    """Distance of lines of equal value, in the layer's unit; 0: none."""
    threshold: tuple[float, float] | None = None
    """Values in this span keep their colours, others are grey; None: all keep them."""

    def palette_of(self, image: LayerImage) -> Palette:
        """The palette that a layer is shown with."""
        return image.palette if self.palette == OWN_PALETTE else display_palette(self.palette)

    def range_of(self, image: LayerImage) -> tuple[float, float]:
        """The values at the palette's ends for a layer of values."""
        if self.range_mode == "locked":
            return self.locked
        if self.range_mode == "capture" and image.range is not None:
            return image.range
        return picture_range(image.field)

    def needs_values(self, palette: Palette) -> bool:
        """Whether pseudo-colours of a palette cannot be shown as they are."""
        own = self.palette == OWN_PALETTE or display_palette(self.palette) == palette
        return not own or self.range_mode != "capture" or self.isotherms > 0 or self.threshold is not None

    def picture(self, image: LayerImage) -> Image8:
        """A layer as 8-bit RGB, shape [H, W, 3]."""
        if image.field is None:
            assert image.colors is not None  # noqa: S101  a layer of colours
            return image.colors
        low, high = self.range_of(image)
        there = np.isfinite(image.field)
        shares = np.clip((np.where(there, image.field, low) - low) / (high - low or 1.0), 0, 1)
        table = rgb_bytes(self.palette_of(image).to_color(np.linspace(0, 1, 1024)))
        picture = table[np.rint(shares * 1023).astype(np.intp)]
        if self.threshold is not None:
            first, last = sorted(self.threshold)
            outside = there & ((image.field < first) | (image.field > last))
            grey = np.rint(40 + 150 * shares).astype(np.uint8)
            picture = np.where(outside[..., None], grey[..., None], picture)
        if self.isotherms > 0:
            picture = np.where(isotherms(image.field, self.isotherms)[..., None], _contrast(picture), picture)
        if image.changed is not None:
            picture = hatched(picture.astype(np.uint8), there & ~image.changed)
        return np.where(there[..., None], picture, _NOTHING).astype(np.uint8)


def picture_range(field: NDArray[np.floating] | None) -> tuple[float, float]:
    """The 1st and the 99th percentile of the values of a picture [H, W]; (0, 1) where it has none."""
    if field is None:
        return 0.0, 1.0
    values = field[np.isfinite(field)]
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values[:: max(1, len(values) // 20_000)], _PERCENTILES)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1e-6 * max(1.0, abs(float(low))))


def isotherms(field: NDArray[np.floating], step: float) -> NDArray[np.bool_]:
    """Mask [H, W] of the pixels where values pass a multiple of a step on the way to the pixel right of or below them.

    Args:
        field: Values, shape [H, W].
        step: Distance of the lines, > 0, in the unit of the values.
    """
    line = np.zeros(field.shape, bool)
    with np.errstate(all="ignore"):  # a step too small for the values' precision has no lines
        level = np.floor(field / step)
        for axis in (0, 1):
            change = np.diff(level, axis=axis)
            passed = np.isfinite(change) & (change != 0)
            line |= np.pad(passed, [(0, int(axis == 0)), (0, int(axis == 1))])
    return line


def compared(first: Image8, second: Image8, how: Comparison, share: float) -> Image8:
    """Two pictures in one.

    Args:
        first: Shape [H, W, 3]; on the left of a wipe.
        second: Shape [H', W', 3]; brought to the size of the first.
        how: "wipe": the first up to a share of the width. "blend": a mixture. "off": the first alone.
        share: Of the width that the first has, or of the second in the mixture, 0 to 1.

    Returns:
        Shape [H, W, 3].
    """
    if how == "off":
        return first
    height, width = first.shape[:2]
    if second.shape != first.shape:
        second = resized(second, width, height)
    if how == "blend":
        return np.rint((1 - share) * first.astype(np.float32) + share * second).astype(np.uint8)
    edge = round(np.clip(share, 0, 1) * width)
    return np.concatenate([first[:, :edge], second[:, edge:]], axis=1)


def _contrast(picture: Image8) -> Image8:
    """Black on what is light, white on what is dark; shape [H, W, 3]."""
    light = picture.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) > 127
    return np.where(light, 0, 255)[..., None].repeat(3, axis=-1).astype(np.uint8)
