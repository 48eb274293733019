"""measurements.json and tables of measurements.

    {"format": "thermosplat-measurements", "version": 1, "metres_per_unit": 0.98, "settings": {"emissivity": 0.93},
     "measurements": [{"name": "S1", "shape": "spot", "layer": "image", "spectrum": "thermal",
                       "view": {"viewmat": [[...]], "fov_y": 50, "width": 1280, "height": 720, "name": ""},
                       "places_px": [[640.5, 360.5]], "settings": {}, "alarm": {"when": "above", "low": 40},
                       "numbers": {...}}],
     "differences": [["S1", "S2"]]}

``view`` is in the world of the capture's own poses. ``numbers`` are what was found there; who measures again finds them
anew (``thermosplat-measure``), so that they may be left out in a file that is written by hand.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.documents import read_document
from thermosplat.thermography.measurement_book import MOST_MEASUREMENTS, Pages
from thermosplat.thermography.measurements import (
    WHENS,
    Alarm,
    Definition,
    Measurement,
    Numbers,
    Standpoint,
)
from thermosplat.thermography.shapes import SHAPES, number_of_points

FOLDER, MEASUREMENTS = "measurements", "measurements.json"
"""The file, and the folder of a run that it lies in."""
FORMAT, VERSION = "thermosplat-measurements", 1
_FURTHEST = 1e9
_HINT = "Save measurements in thermosplat-view, or look at docs/temperatures.md for the form of the file."


def write_book(path: Path, pages: Pages) -> None:
    """Write measurements.json.

    Args:
        path: The file; its folder is made.
        pages: What it is to hold.
    """
    content = {
        "format": FORMAT,
        "version": VERSION,
        "metres_per_unit": pages.metres_per_unit,
        "settings": pages.settings,
        "measurements": [entry(one, pages.metres_per_unit) for one in pages.measurements],
        "differences": [_difference(pages, *pair) for pair in pages.differences],
    }
    write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def entry(one: Measurement, metres_per_unit: float | None) -> dict[str, Any]:
    """A measurement as JSON has it, complete.

    Args:
        one: The measurement.
        metres_per_unit: Length of a world unit [m]; None: nobody knows it, and lengths are in world units alone.
    """
    said, found = one.definition, one.numbers
    view = said.standpoint
    alarm = None
    if said.alarm is not None:
        alarm = {"when": said.alarm.when, "low": said.alarm.low}
        alarm |= {"high": said.alarm.high} if said.alarm.when == "between" else {}
    metric = {}
    if metres_per_unit is not None:
        metric = {
            "length_m": None if found.length is None else found.length * metres_per_unit,
            "area_m2": None if found.area is None else found.area * metres_per_unit**2,
            "alarm_area_m2": None if found.alarm_area is None else found.alarm_area * metres_per_unit**2,
        }
    return {
        "name": said.name,
        "shape": said.shape,
        "layer": said.layer,
        "spectrum": said.spectrum,
        "view": {
            "viewmat": view.viewmat.tolist(),
            "fov_y": view.fov_y,
            "width": view.width,
            "height": view.height,
            "name": view.name,
        },
        "places_px": [list(place) for place in said.places],
        "settings": dict(said.settings),
        "alarm": alarm,
        "numbers": {**asdict(found), **metric},
    }


def _difference(pages: Pages, first: str, second: str) -> dict[str, Any]:
    found = pages.difference(first, second)
    return {
        "of": [first, second],
        "value": None if found is None else found[0],
        "unit": None if found is None else found[1],
    }


def read_book(path: Path) -> tuple[Pages, list[Definition]]:
    """What a measurements.json holds.

    Returns:
        Its pages, of which measurements without numbers are missing; and all definitions, in their order.

    Raises:
        UserError: It cannot be read, or is something else.
    """
    content = read_document(path, "measurements", VERSION, _HINT)
    entries = content.get("measurements")
    if not isinstance(entries, list) or len(entries) > MOST_MEASUREMENTS:
        raise UserError(f"{path} must have a list of at most {MOST_MEASUREMENTS} measurements.", _HINT)
    definitions, known = [], []
    for number, stated in enumerate(entries, 1):
        definition = _checked(path, number, stated, _definition)
        definitions.append(definition)
        if isinstance(stated.get("numbers"), dict):
            known.append(Measurement(definition, _checked(path, number, stated["numbers"], _numbers)))
    names = [definition.name for definition in definitions]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{path} has two measurements that are called {twice}.", "Give each a name of its own.")
    differences = []
    for stated in content.get("differences") or []:
        pair = stated.get("of") if isinstance(stated, dict) else stated
        if isinstance(pair, list) and len(pair) == 2 and set(map(str, pair)) <= set(names):
            differences.append((str(pair[0]), str(pair[1])))
    settings = _settings(content.get("settings"), path)
    return Pages(tuple(known), tuple(differences), _scale(content, path), settings), definitions


def read_scale(path: Path) -> float | None:
    """The length of a world unit [m] that a measurements.json states; None where there is no file, or it states none.

    Raises:
        UserError: It is something else.
    """
    return _scale(read_document(path, "measurements", VERSION, _HINT), path) if path.is_file() else None


def _checked(path: Path, number: int, stated: Any, understood: Callable[[Any], Any]) -> Any:
    try:
        return understood(stated)
    except UserError as error:
        raise UserError(f"{path}, measurement {number}: {error.message}", error.hint) from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        found = f"{type(error).__name__}: {error}"
        raise UserError(f"{path}: measurement {number} is none ({found[:120]}).", _HINT) from error


def _definition(stated: Any) -> Definition:
    shape = next(one for one in (*SHAPES, None) if one == stated["shape"] or one is None)
    if shape is None:
        raise UserError(f"{str(stated['shape'])[:40]} is no shape.", f"Known are {', '.join(SHAPES)}.")
    view = stated["view"]
    viewmat = np.array(view["viewmat"], np.float64)
    rotation = viewmat[:3, :3]
    if viewmat.shape != (4, 4) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise ValueError("its viewmat is no pose")
    width, height, fov_y = int(view["width"]), int(view["height"]), float(view["fov_y"])
    if not (1 <= width <= 16_384 and 1 <= height <= 16_384 and width * height <= 3840 * 2160 and 0.1 <= fov_y <= 179):
        raise ValueError("its view is no picture")
    standpoint = Standpoint(viewmat, fov_y, width, height, str(view.get("name", ""))[:200])
    places = tuple((_finite(x), _finite(y)) for x, y in stated["places_px"])
    fewest, most = number_of_points(shape)
    if not fewest <= len(places) <= most:
        raise ValueError(f"a {shape} has {fewest} to {most} places")
    return Definition(
        name=str(stated["name"])[:40],
        shape=shape,
        layer=str(stated["layer"]),
        spectrum=str(stated["spectrum"]),
        standpoint=standpoint,
        places=places,
        settings=_settings(stated.get("settings"), None),
        alarm=_alarm(stated.get("alarm")),
    )


def _alarm(stated: Any) -> Alarm | None:
    if stated is None:
        return None
    when = next(one for one in WHENS if one == stated["when"])
    return Alarm(when, _finite(stated["low"]), _finite(stated["high"]) if when == "between" else math.inf)


def _settings(stated: Any, path: Path | None) -> dict[str, float]:
    values = {str(name): float(value) for name, value in (stated or {}).items()}
    known = {one.name for one in fields(TemperatureSettings)} - {"labels"}
    if unknown := sorted(values.keys() - known):
        raise UserError(
            f"{path or 'its settings'} has the setting {unknown[0][:40]}.", f"Known are {', '.join(sorted(known))}."
        )
    settings: dict[str, Any] = dict(values)
    return TemperatureSettings(**settings).checked("" if path is None else f"{path}: ").given


def _numbers(stated: Any) -> Numbers:
    values = {one.name: stated.get(one.name, one.default) for one in fields(Numbers)}
    if missing := [name for name, value in values.items() if value is MISSING]:
        raise KeyError(missing[0])
    for name in ("minimum_px", "maximum_px"):
        values[name] = tuple(map(_finite, values[name]))
    for name in ("minimum_point", "maximum_point"):
        values[name] = None if values[name] is None else tuple(map(_finite, values[name]))
    values["points"] = tuple(None if point is None else tuple(map(_finite, point)) for point in values["points"])
    for name in ("reasons", "doubts"):
        values[name] = tuple(map(str, values[name]))
    for name in ("minimum", "maximum", "mean", "std", "recalculated_share", "doubted_share"):
        values[name] = _finite(values[name])
    for name in ("length", "area", "alarm_share", "alarm_area", "uncertainty"):
        values[name] = None if values[name] is None else _finite(values[name])
    values["count"] = int(values["count"])
    for name in ("quantity", "unit", "recalculated"):
        values[name] = str(values[name])
    values["decimals"] = min(max(int(values["decimals"]), 0), 9)
    return Numbers(**values)


def _scale(content: dict[str, Any], path: Path) -> float | None:
    scale = content.get("metres_per_unit")
    if scale is None:
        return None
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < _FURTHEST:
        raise UserError(f"{path}: metres_per_unit must be a length in metres.", _HINT)
    return float(scale)


def _finite(value: Any) -> float:
    number = float(value)
    if not abs(number) <= _FURTHEST:
        raise ValueError(f"{value} is no number")
    return number


COLUMNS = (
    *("name", "shape", "layer", "spectrum", "quantity", "unit", "min", "max", "mean", "plus_minus", "std", "pixels"),
    *("length_m", "area_m2", "length_world", "area_world2", "alarm", "alarm_share", "alarm_area_m2"),
    *("min_px", "max_px", "min_point", "max_point", "points", "places_px", "picture_px", "view", "fov_y", "viewmat"),
    *("recalculated", "recalculated_share", "reasons", "doubted_share", "doubts"),
)
"""Of the table, one row for each measurement and one for each difference."""


def table_text(pages: Pages) -> str:
    """Measurements and differences as CSV, with all digits: places in px, points and views in the capture's world."""
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, restval="")
    writer.writeheader()
    for one in pages.measurements:
        said, found, metric = one.definition, one.numbers, entry(one, pages.metres_per_unit)["numbers"]
        writer.writerow(
            {
                **{"name": said.name, "shape": said.shape, "layer": said.layer, "spectrum": said.spectrum},
                **{"quantity": found.quantity, "unit": found.unit, "min": found.minimum, "max": found.maximum},
                **{"mean": found.mean, "plus_minus": found.uncertainty, "std": found.std, "pixels": found.count},
                **{name: metric.get(name) for name in ("length_m", "area_m2", "alarm_area_m2")},
                **{"length_world": found.length, "area_world2": found.area},
                **{"alarm": said.alarm.text if said.alarm else "", "alarm_share": found.alarm_share},
                **{"min_px": _spaced(found.minimum_px), "max_px": _spaced(found.maximum_px)},
                **{"min_point": _spaced(found.minimum_point), "max_point": _spaced(found.maximum_point)},
                **{"points": _listed(found.points), "places_px": _listed(said.places)},
                "picture_px": f"{said.standpoint.width} {said.standpoint.height}",
                **{"view": said.standpoint.name, "fov_y": said.standpoint.fov_y},
                "viewmat": _spaced(said.standpoint.viewmat.ravel().tolist()),
                **{"recalculated": found.recalculated, "recalculated_share": found.recalculated_share},
                **{"reasons": " ".join(found.reasons), "doubted_share": found.doubted_share},
                "doubts": "; ".join(found.doubts),
            }
        )
    for first, second in pages.differences:
        if (found_difference := pages.difference(first, second)) is not None:
            value, unit = found_difference
            writer.writerow({"name": f"{first} - {second}", "shape": "difference", "unit": unit, "mean": value})
    return table.getvalue()


def _spaced(numbers: Iterable[float] | None) -> str:
    return "" if numbers is None else " ".join(map(repr, numbers))


def _listed(points: Iterable[Iterable[float] | None]) -> str:
    return "; ".join(map(_spaced, points))
