"""Pictures for the eye: ground truth, render and error of one frame beside each other, a row per spectrum."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermosplat.pictures.color_bar import color_bar, write_text
from thermosplat.pictures.image_display import Image8, error_bytes, resized
from thermosplat.thermal.radiometry import Palette

HEADER_HEIGHT = 20  # [px], room for one line of text
GAP = 4  # [px] between panels and rows
LEAST_PANEL_WIDTH = 240  # [px]; smaller images are enlarged so that the titles fit
FONT_SCALE = 0.42


@dataclass(frozen=True)
class Comparison:
    """One spectrum of one frame."""

    label: str
    """What is shown, e.g. "RGB"."""
    score: str
    """The render's number, e.g. "24.31 dB"."""
    truth: Image8
    """Ground truth, 8-bit colours, shape [H, W, 3]."""
    render: Image8
    """Render, 8-bit colours, shape [H, W, 3]."""
    error: NDArray[np.floating]
    """Absolute error, shape [H, W], in the unit of ``largest_error``."""
    largest_error: float
    """Error at the bright end of the error map's palette."""
    unit: str = ""
    """Unit of the error, e.g. "°C"."""
    bar: tuple[Palette, float, float] | None = None
    """Palette of ground truth and render, and the values at its ends, in that unit; None: they have colours alone."""


def comparison_strip(comparisons: list[Comparison]) -> Image8:
    """The picture of a frame.

    Args:
        comparisons: The frame's spectra, at least one; they may differ in image size.

    Returns:
        8-bit RGB: a row per spectrum with ground truth, render and error map, each under its title.
    """
    panel_width = max(max(comparison.truth.shape[1] for comparison in comparisons), LEAST_PANEL_WIDTH)
    rows = [_row(comparison, panel_width) for comparison in comparisons]
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    gap = np.zeros((GAP, rows[0].shape[1], 3), np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)][:-1])


def _row(comparison: Comparison, width: int) -> Image8:
    error = error_bytes(comparison.error, comparison.largest_error)
    panels = [
        titled(f"{comparison.label} ground truth", comparison.truth, width),
        titled(f"render {comparison.score}", comparison.render, width),
        titled("error 0", error, width, palette_end=f"{comparison.largest_error:.2g} {comparison.unit}".rstrip()),
    ]
    height = panels[0].shape[0]
    if comparison.bar is not None:
        panels.append(color_bar(*comparison.bar, comparison.unit, max(60, height))[:height])
    gap = np.zeros((height, GAP, 3), np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)


def titled(title: str, image: Image8, width: int, palette_end: str | None = None) -> Image8:
    """An image under its title.

    Args:
        title: One line, ASCII and "°".
        image: 8-bit RGB, shape [H, W, 3].
        width: Width of the result [px].
        palette_end: For an error map: what stands at the bright end of its palette, which is drawn beside the title.

    Returns:
        8-bit RGB, shape [HEADER_HEIGHT + H', width, 3].
    """
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    header = np.zeros((HEADER_HEIGHT, width, 3), np.uint8)
    pen = _write(header, title, x=4)
    if palette_end is not None:
        bar = error_bytes(np.linspace(0.0, 1.0, 64)[None].repeat(HEADER_HEIGHT - 10, axis=0), 1.0)
        header[5:-5, pen + 6 : pen + 6 + bar.shape[1]] = bar[:, : max(0, width - pen - 6)]
        _write(header, palette_end, x=pen + bar.shape[1] + 12)
    return np.concatenate([header, resized(image, width, height)])


def _write(header: Image8, text: str, x: int) -> int:
    """Write a line of text; returns the x [px] where it ends."""
    return write_text(header, text, x, HEADER_HEIGHT - 6, FONT_SCALE, 1)
