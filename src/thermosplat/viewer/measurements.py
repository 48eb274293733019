"""What is measured in a picture: spots, lines and areas, with minimum, maximum, mean and standard deviation.

A measurement keeps the numbers of the picture in which it was made, and the points of the scene that it lies on, so
that its marks stay on the object when the camera moves. Values are those of the layer: degrees where the capture has
them, intensities from 0 to 1 where it has not.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.pictures.color_bar import color_bar, write_text
from thermosplat.pictures.image_display import Image8, write_png
from thermosplat.runs.atomic_writes import write_text as write_text_file
from thermosplat.thermal.radiometry import Palette
from thermosplat.viewer.layers import LayerImage

Shape = Literal["spot", "line", "area"]
Pixel = tuple[float, float]
COLUMNS = ("name", "shape", "layer", "quantity", "unit", "min", "max", "mean", "std", "pixels", "view", "points_px")


@dataclass(frozen=True)
class Measurement:
    """One measurement, as it was made."""

    name: str
    """Such as "S1", "L2" or "A3"."""
    shape: Shape
    """Of what."""
    layer: str
    """Label of the layer that was measured."""
    quantity: str
    """What was measured, such as "temperature"."""
    unit: str
    """Its unit for people; "" for intensities and the like."""
    minimum: float
    """The least value."""
    maximum: float
    """The largest value."""
    mean: float
    """Mean of the values."""
    std: float
    """Standard deviation of the values (of the population: divided by their number)."""
    count: int
    """Pixels with a value."""
    decimals: int
    """Digits behind the point to show."""
    points_px: tuple[Pixel, ...]
    """Where: one position, two ends, or two corners, in shares of width and height, 0 to 1."""
    points: tuple[tuple[float, float, float], ...] = ()
    """Points of the scene under the marks, in its frame; empty where nothing was seen there."""
    view: str = ""
    """The view's name, for the table."""

    @property
    def text(self) -> str:
        """The number for people: "23.41 °C", or the mean with its span."""
        if self.shape == "spot":
            return self.mean_text
        span = f"{self.minimum:.{self.decimals}f} to {self.maximum:.{self.decimals}f}"
        return f"{self.mean_text} ({span}, std {self.std:.{self.decimals}f})"

    @property
    def mean_text(self) -> str:
        """The mean alone, for a label beside the mark."""
        return with_unit(self.mean, self.unit, self.decimals)


def with_unit(value: float, unit: str, decimals: int) -> str:
    """A value for people."""
    return f"{value:.{decimals}f} {unit}".rstrip()


def value_at(image: LayerImage, x: float, y: float) -> float | None:
    """The value under a point of a picture.

    Args:
        image: The layer.
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


def measure(image: LayerImage, shape: Shape, points: Sequence[Pixel], name: str) -> Measurement | None:
    """Measure a layer.

    Args:
        image: The layer, of values.
        shape: "spot" at one point, "line" between two, "area" of the rectangle between two.
        points: In shares of width and height; those outside of the picture are moved to its edge.
        name: What the measurement is called.

    Returns:
        The measurement; None of a layer of colours and where no pixel has a value.
    """
    if image.field is None:
        return None
    points = [(min(max(float(x), 0.0), 1.0), min(max(float(y), 0.0), 1.0)) for x, y in points]
    values = covered_values(image.field, shape, points)
    values = values[np.isfinite(values)].astype(np.float64)
    if not len(values):
        return None
    return Measurement(
        name,
        shape,
        image.layer.label,
        image.quantity,
        image.unit,
        float(values.min()),
        float(values.max()),
        float(values.mean()),
        float(values.std()),
        len(values),
        image.decimals,
        tuple(points),
    )


def covered_values(field: NDArray[np.float32], shape: Shape, points: Sequence[Pixel]) -> NDArray[np.float32]:
    """The values of a field [H, W] under a spot, along a line in its order, or inside an area; NaN where there is none.

    Args:
        field: Values.
        shape: As of ``measure``.
        points: As of ``measure``.
    """
    height, width = field.shape
    size = np.array([width, height])
    at = np.clip(np.floor(np.asarray(points, np.float64) * size), 0, size - 1).astype(int)
    if shape == "spot":
        return field[at[0, 1], at[0, 0]][None]
    (x0, y0), (x1, y1) = at[0], at[1]
    if shape == "line":
        count = int(max(abs(x1 - x0), abs(y1 - y0))) + 1
        columns = np.rint(np.linspace(x0, x1, count)).astype(int)
        rows = np.rint(np.linspace(y0, y1, count)).astype(int)
        return field[rows, columns]
    return field[min(y0, y1) : max(y0, y1) + 1, min(x0, x1) : max(x0, x1) + 1].ravel()


def write_measurements(path: Path, measurements: Sequence[Measurement]) -> None:
    """Write measurements as a table, one row each.

    Args:
        path: The CSV file; its folder is made.
        measurements: In the order of the rows. Numbers are not rounded.
    """
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(COLUMNS)
    for m in measurements:
        places = " ".join(f"({x:.4f} {y:.4f})" for x, y in m.points_px)
        numbers = [repr(number) for number in (m.minimum, m.maximum, m.mean, m.std)]
        writer.writerow([m.name, m.shape, m.layer, m.quantity, m.unit, *numbers, m.count, m.view, places])
    write_text_file(path, table.getvalue())


def marked_picture(
    picture: Image8,
    marks: Sequence[tuple[Measurement, Sequence[Pixel]]],
    legend: tuple[Palette, float, float, str] | None = None,
) -> Image8:
    """A picture with marks of measurements on it, and its legend beside it.

    Args:
        picture: 8-bit RGB, shape [H, W, 3].
        marks: Measurements, and where their points lie in this picture, in shares of width and height.
        legend: Palette, lowest and highest value and unit of the picture; None: no legend.

    Returns:
        8-bit RGB, shape [H, W', 3].
    """
    marked = np.ascontiguousarray(picture.copy())
    height, width = marked.shape[:2]
    size, stroke = max(0.4, height / 1000), max(1, round(height / 500))
    labels: list[tuple[str, tuple[int, int]]] = []
    for measurement, places in marks:
        pixels = [(round(x * width), round(y * height)) for x, y in places]
        for color, thickness in (((0, 0, 0), stroke + 2), ((255, 255, 255), stroke)):
            if measurement.shape == "spot":
                cv2.drawMarker(marked, pixels[0], color, cv2.MARKER_CROSS, round(32 * size), thickness)
            elif measurement.shape == "line":
                cv2.line(marked, pixels[0], pixels[1], color, thickness, cv2.LINE_AA)
            else:
                cv2.polylines(marked, [np.array(pixels, np.int32)], True, color, thickness, cv2.LINE_AA)
        labels.append((f"{measurement.name} {measurement.mean_text}", pixels[0]))
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


def save_measurements(
    folder: Path, stem: str, measurements: Sequence[Measurement], picture: Image8
) -> tuple[Path, Path]:
    """Write a table of measurements and the picture of them beside each other.

    Args:
        folder: Made where there is none.
        stem: Name of both files without their ending.
        measurements: Rows of the table.
        picture: As of ``marked_picture``.

    Returns:
        The CSV file and the PNG file.
    """
    table, image = folder / f"{stem}.csv", folder / f"{stem}.png"
    write_measurements(table, measurements)
    write_png(image, picture)
    return table, image
