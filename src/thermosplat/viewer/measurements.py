"""Measurements in pictures: the value under a point, marks on a saved picture, and the files that are saved."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from thermosplat.pictures.color_bar import color_bar, write_text
from thermosplat.pictures.image_display import Image8, write_png
from thermosplat.runs.atomic_writes import write_text as write_text_file
from thermosplat.thermal.radiometry import Palette
from thermosplat.thermography.measurement_book import Pages
from thermosplat.thermography.measurements_file import table_text, write_book
from thermosplat.thermography.shapes import Shape
from thermosplat.viewer.layers import LayerImage

Pixel = tuple[float, float]
"""A place in shares of width and height, 0 to 1."""
_COLDEST, _HOTTEST = (90, 170, 255), (255, 80, 60)


@dataclass(frozen=True)
class Mark:
    """A measurement as it lies in a picture."""

    text: str
    shape: Shape
    outline: tuple[Pixel, ...]
    """Its corners."""
    minimum: Pixel | None = None
    """Where its least value is."""
    maximum: Pixel | None = None
    """Where its largest value is."""


def value_at(image: LayerImage, x: float, y: float) -> float | None:
    """The value under a point of a picture.

    Args:
        x: Share of the width, 0 to 1.
        y: Share of the height, 0 to 1.

    Returns:
        The pixel's value; None outside, of a layer of colours, and where there is none.
    """
    if image.field is None or not (0 <= x <= 1 and 0 <= y <= 1):
        return None
    height, width = image.field.shape
    value = float(image.field[min(int(y * height), height - 1), min(int(x * width), width - 1)])
    return value if np.isfinite(value) else None


def marked_picture(
    picture: Image8,
    marks: Sequence[Mark],
    legend: tuple[Palette, float, float, str] | None = None,
) -> Image8:
    """A picture with marks of measurements on it, and its legend beside it.

    Args:
        picture: 8-bit RGB, shape [H, W, 3].
        legend: Palette, lowest and highest value and unit of the picture; None: no legend.

    Returns:
        8-bit RGB, shape [H, W', 3].
    """
    marked = np.ascontiguousarray(picture.copy())
    height, width = marked.shape[:2]
    size, stroke = max(0.4, height / 1000), max(1, round(height / 500))
    labels: list[tuple[str, tuple[int, int]]] = []
    for mark in marks:
        pixels = [(round(x * width), round(y * height)) for x, y in mark.outline]
        for color, thickness in (((0, 0, 0), stroke + 2), ((255, 255, 255), stroke)):
            if mark.shape == "spot":
                cv2.drawMarker(marked, pixels[0], color, cv2.MARKER_CROSS, round(32 * size), thickness)
            elif mark.shape == "line":
                cv2.line(marked, pixels[0], pixels[1], color, thickness, cv2.LINE_AA)
            else:
                cv2.polylines(marked, [np.array(pixels, np.int32)], True, color, thickness, cv2.LINE_AA)
        for place, color in ((mark.minimum, _COLDEST), (mark.maximum, _HOTTEST)):
            if place is not None:
                at = round(place[0] * width), round(place[1] * height)
                cv2.circle(marked, at, round(9 * size), (0, 0, 0), stroke + 2, cv2.LINE_AA)
                cv2.circle(marked, at, round(9 * size), color, stroke, cv2.LINE_AA)
        labels.append((mark.text, pixels[0]))
    _write_labels(marked, labels, size, stroke)
    if legend is None:
        return marked
    palette, low, high, unit = legend
    return np.concatenate([marked, color_bar(palette, low, high, unit, max(height, 60))[:height]], axis=1)


def _write_labels(picture: Image8, labels: Sequence[tuple[str, tuple[int, int]]], size: float, stroke: int) -> None:
    """White texts on darkened patches beside their points, none over another one where there is room."""
    taken: list[tuple[int, int, int, int]] = []
    gap = round(12 * size)
    for text, (x, y) in labels:
        (width, height), below = cv2.getTextSize(text.replace("°", "o"), cv2.FONT_HERSHEY_SIMPLEX, size, stroke)
        width, height = width + 8, height + below + 6
        last_x, last_y = max(picture.shape[1] - width, 0), max(picture.shape[0] - height, 0)
        columns, rows = (x + gap, x - gap - width), [y - gap - height, y + gap, *(y + k * height for k in range(-4, 5))]
        places = [(min(max(a, 0), last_x), min(max(b, 0), last_y)) for b in rows for a in columns]
        left, top = next(
            ((a, b) for a, b in places if all(not _overlap((a, b, width, height), other) for other in taken)), places[0]
        )
        taken.append((left, top, width, height))
        patch = picture[top : top + height, left : left + width]
        patch[:] = patch // 3
        write_text(picture, text, left + 4, top + height - below - 2, size, stroke)


def _overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> bool:
    """Whether two boxes (left, top, width, height) have pixels in common."""
    return all(one[k] < other[k] + other[k + 2] and other[k] < one[k] + one[k + 2] for k in (0, 1))


def save_measurements(folder: Path, stem: str, pages: Pages, picture: Image8) -> tuple[Path, Path]:
    """Write measurements as a table and as JSON, and the picture of them beside that.

    Args:
        pages: The measurements. Numbers are not rounded.

    Returns:
        The CSV file and the PNG file.
    """
    table, image = folder / f"{stem}.csv", folder / f"{stem}.png"
    write_text_file(table, table_text(pages))
    write_book(folder / f"{stem}.json", pages)
    write_png(image, picture)
    return table, image
