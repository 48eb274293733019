"""Measurements: where something is measured, and the numbers that are found there.

A definition is a shape in the picture of a standpoint, of a layer of a spectrum. Its numbers are those of the picture
that is rendered from there, at that size. So whoever renders it again has the same numbers: the viewer,
thermosplat-measure, and Python. The outline and the extremes are anchored on points of the scene, in the world of the
capture's own poses.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from thermosplat.thermography.certainty import DOUBTS, Sure
from thermosplat.thermography.extents import area_of, points_at
from thermosplat.thermography.shapes import AREAS, Place, Shape, covered, outline

When = Literal["above", "below", "between"]
WHENS: tuple[When, ...] = get_args(When)
Point = tuple[float, float, float]
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Standpoint:
    """A camera that looks through the middle of its picture."""

    viewmat: Array
    """World to camera, OpenCV axes, [4, 4], in the world of the capture's own poses."""
    fov_y: float
    """Vertical field of view [degrees]."""
    width: int
    """Of the picture [px]."""
    height: int
    """Of the picture [px]."""
    name: str = ""
    """What somebody calls it."""

    @property
    def K(self) -> Array:
        """Intrinsics [px], [3, 3]."""
        focal = self.height / (2 * math.tan(math.radians(self.fov_y) / 2))
        return np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])

    @property
    def pose(self) -> Array:
        """Camera to world, [4, 4]."""
        return np.linalg.inv(self.viewmat).astype(np.float64)


@dataclass(frozen=True)
class Alarm:
    """Values that somebody is to be told of."""

    when: When
    """Which."""
    low: float
    """The limit, in the layer's unit; of "between" the lower one."""
    high: float = math.inf
    """The upper one of "between"."""

    def holds(self, values: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Where values are such; never where there is none."""
        with np.errstate(invalid="ignore"):
            if self.when == "above":
                return values > self.low
            return values < self.low if self.when == "below" else (values >= self.low) & (values <= self.high)

    @property
    def text(self) -> str:
        """For people: "above 40"."""
        return f"between {self.low:g} and {self.high:g}" if self.when == "between" else f"{self.when} {self.low:g}"


@dataclass(frozen=True, eq=False)
class Definition:
    """What is measured, and where."""

    name: str
    """Its name, which no other one has."""
    shape: Shape
    """Of what."""
    layer: str
    """Kind of the layer: "image", "depth", "error", ..."""
    spectrum: str
    """In which spectrum."""
    standpoint: Standpoint
    """From where."""
    places: tuple[Place, ...]
    """Its places in that picture [px]."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """What temperatures are recalculated with here, by names of ``TemperatureSettings``; the rest is the scene's."""
    alarm: Alarm | None = None
    """What it watches for."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A layer as it was rendered from a standpoint."""

    values: NDArray[np.floating]
    """[H, W], NaN where there is none."""
    depth: NDArray[np.floating] | None
    """z-depth [world units], [H, W], NaN where nothing is; None: not known."""
    quantity: str
    """What the values are, such as "temperature"."""
    unit: str
    """Their unit for people; "" where they have none."""
    decimals: int
    """Digits behind the point to show."""
    changed: NDArray[np.bool_] | None = None
    """Where temperatures were recalculated, [H, W]; None: nowhere."""
    recalculated: str = ""
    """How, for people."""
    reasons: tuple[str, ...] = ()
    """Why they were not elsewhere."""
    sure: Sure | None = None
    """How sure the values are; None: nobody knows."""


@dataclass(frozen=True)
class Numbers:
    """What was found. Places are [px], points in the world; None where there is none."""

    quantity: str
    unit: str
    decimals: int
    minimum: float
    maximum: float
    mean: float
    std: float
    """Standard deviation (of the population: divided by their number)."""
    count: int
    """Pixels with a value."""
    minimum_px: Place
    maximum_px: Place
    minimum_point: Point | None
    maximum_point: Point | None
    points: tuple[Point | None, ...]
    """Of the outline's corners."""
    length: float | None
    """Of a line [world units]."""
    area: float | None
    """Of an area's surface [world units²]."""
    alarm_share: float | None
    """Share of the pixels for which the alarm holds."""
    alarm_area: float | None
    """Their surface [world units²]."""
    recalculated: str
    """How temperatures were recalculated; ""."""
    recalculated_share: float
    """Share of the pixels whose were."""
    reasons: tuple[str, ...]
    """Why others' were not."""
    uncertainty: float | None = None
    """Half of the 95% interval of the mean; errors of neighbouring pixels are taken for one and the same."""
    doubted_share: float = 0.0
    """Share of the pixels that should not be read."""
    doubts: tuple[str, ...] = ()
    """Why not."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """A definition and what was found there."""

    definition: Definition
    numbers: Numbers

    @property
    def name(self) -> str:
        """Its name."""
        return self.definition.name

    @property
    def mean_text(self) -> str:
        """The mean for people: "23.41 °C"; recalculated ones say so."""
        found = self.numbers
        mark = " (recalculated)" if found.recalculated_share > 0 else ""
        if found.uncertainty is None:
            return f"{with_unit(found.mean, found.unit, found.decimals)}{mark}"
        digits = 1 if found.uncertainty >= 0.1 else 2
        return f"{with_unit(found.mean, f'± {found.uncertainty:.{digits}f} {found.unit}', digits)}{mark}"

    @property
    def text(self) -> str:
        """The numbers for people: the mean, with its span where it is of more than a spot."""
        if self.definition.shape == "spot":
            return self.mean_text
        digits, found = self.numbers.decimals, self.numbers
        span = f"{found.minimum:.{digits}f} to {found.maximum:.{digits}f}"
        return f"{self.mean_text} ({span}, std {found.std:.{digits}f})"

    def extent_text(self, metres_per_unit: float | None) -> str:
        """Length or area for people, in metres where the scene has a scale; "" where there is none."""
        length, area = self.numbers.length, self.numbers.area
        if length is not None:
            return f"{length * (metres_per_unit or 1):.3g} {'m' if metres_per_unit else 'world units'}"
        if area is not None:
            return f"{area * (metres_per_unit or 1) ** 2:.3g} {'m²' if metres_per_unit else 'world units²'}"
        return ""


def with_unit(value: float, unit: str, decimals: int) -> str:
    """A value for people."""
    return f"{value:.{decimals}f} {unit}".rstrip()


def measure(definition: Definition, seen: Seen) -> Numbers | None:
    """Measure a layer.

    Args:
        definition: What and where.
        seen: The layer from the definition's standpoint.

    Returns:
        The numbers; None where no pixel has a value.
    """
    height, width = seen.values.shape
    rows, columns = covered(definition.shape, definition.places, width, height)
    values = seen.values[rows, columns].astype(np.float64)
    there = np.isfinite(values)
    if not there.any():
        return None
    rows, columns, values = rows[there], columns[there], values[there]
    standpoint = definition.standpoint
    K, pose = standpoint.K, standpoint.pose
    low, high = (_middle_of(rows[k], columns[k]) for k in (int(values.argmin()), int(values.argmax())))
    corners = outline(definition.shape, definition.places)
    depth = seen.depth
    found = [None] * (len(corners) + 2) if depth is None else points_at([*corners, low, high], depth, K, pose)
    points = [None if point is None else (float(point[0]), float(point[1]), float(point[2])) for point in found]
    first, last = found[0], found[len(corners) - 1]
    is_area = definition.shape in AREAS
    length = None
    if definition.shape == "line" and first is not None and last is not None:
        length = float(np.linalg.norm(last - first))
    alarmed = None if definition.alarm is None else definition.alarm.holds(values)
    changed = np.zeros(len(values), bool) if seen.changed is None else seen.changed[rows, columns]
    return Numbers(
        quantity=seen.quantity,
        unit=seen.unit,
        decimals=seen.decimals,
        minimum=float(values.min()),
        maximum=float(values.max()),
        mean=float(values.mean()),
        std=float(values.std()),
        count=len(values),
        minimum_px=low,
        maximum_px=high,
        minimum_point=points[-2],
        maximum_point=points[-1],
        points=tuple(points[:-2]),
        length=length,
        area=area_of((rows, columns), depth, K) if is_area and depth is not None else None,
        alarm_share=None if alarmed is None else float(alarmed.mean()),
        alarm_area=(
            area_of((rows[alarmed], columns[alarmed]), depth, K)
            if is_area and depth is not None and alarmed is not None
            else None
        ),
        recalculated=seen.recalculated if changed.any() else "",
        recalculated_share=float(changed.mean()),
        reasons=seen.reasons if not changed.all() else (),
        **_how_sure(seen.sure, rows, columns),
    )


def _how_sure(sure: Sure | None, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> dict[str, Any]:
    """The fields of ``Numbers`` on that."""
    if sure is None:
        return {}
    half, doubts = sure.half_width[rows, columns], sure.doubts[rows, columns]
    known = np.isfinite(half)
    named = sorted((text for bit, text in DOUBTS.items() if (doubts & bit).any()), key=list(DOUBTS.values()).index)
    return {
        "uncertainty": float(np.sqrt(np.mean(half[known] ** 2))) if known.any() else None,
        "doubted_share": float((doubts > 0).mean()),
        "doubts": tuple(named),
    }


def profile(definition: Definition, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """The values along a line, in its order; NaN where there is none.

    Args:
        definition: The line.
        values: The layer, [H, W].
    """
    height, width = values.shape
    return values[covered("line", definition.places, width, height)]


def _middle_of(row: Any, column: Any) -> Place:
    return float(column) + 0.5, float(row) + 0.5
