"""Units of radiometric images: into °C, and whether values can be what they are said to be."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.values import shown
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.spectra import CELSIUS, COUNTS, TEMPERATURE_UNITS, unit_named

_TO_CELSIUS: dict[str, tuple[float, float]] = {
    "kelvin": (1.0, -273.15),
    "decikelvin": (0.1, -273.15),
    "centikelvin": (0.01, -273.15),
    "millikelvin": (0.001, -273.15),
    "celsius": (1.0, 0.0),
    "decicelsius": (0.1, 0.0),
    "centicelsius": (0.01, 0.0),
    "fahrenheit": (5 / 9, -32 * 5 / 9),
}
"""Factor and offset of each unit with degrees."""
_POSSIBLE_CELSIUS = (-150.0, 3000.0)
"""Temperatures [°C] outside of which a stated unit must be wrong; a clear sky reads as low as about -100."""
ABSOLUTE_ZERO = -273.15
"""[°C]."""
_HOTTEST_RANGE = 10_000.0
"""Highest end of a stated range [°C]: beyond the range of any thermal camera."""
_LARGEST_JSON = 1 << 26
"""Most bytes of a JSON file: a transforms file has about 600 for a frame."""
_USUAL_CELSIUS = (-60.0, 600.0)
"""Temperatures [°C] within which values are taken for a unit that nobody stated."""


@dataclass(frozen=True)
class RadiometricStatement:
    """What a capture says of its radiometric values (``units.json``); None for what it does not say."""

    unit: str | None = None
    palette_celsius: tuple[float, float] | None = None


def may_be_temperature(unit: str) -> bool:
    """Whether images with this setting of ``SpectrumConfig.unit`` may be temperatures."""
    return unit == "auto" or unit in TEMPERATURE_UNITS


def measured_unit(unit: str) -> str | None:
    """The unit in which values of a unit are reported: °C for temperatures; None for counts, which have none."""
    return None if unit == COUNTS else CELSIUS if unit in TEMPERATURE_UNITS else unit


def to_measured(values: NDArray[Any], unit: str, factor: float = 1.0) -> NDArray[np.float32] | None:
    """Values in the unit in which they are reported, float32, same shape; None for counts, which have none.

    Args:
        values: As the file holds them.
        factor: What values of another unit than a temperature's are multiplied by.
    """
    if unit == COUNTS:
        return None
    factor, offset = _TO_CELSIUS.get(unit, (factor, 0.0))
    return (values.astype(np.float64) * factor + offset).astype(np.float32)


def judge_unit(low: float, high: float, *, integer: bool) -> str:
    """The unit in which a range of values is a usual temperature; counts if there is none.

    Integers are never taken for whole degrees or for hundredths of a °C: sensor counts of a few thousand look the same.

    Args:
        low: Low end of the values (a percentile, so that dead pixels do not matter).
        high: High end.
        integer: The files hold integers.
    """
    candidates: tuple[str, ...] = ("centikelvin",) if integer else ("centikelvin", "kelvin", "celsius")
    for unit in candidates:
        factor, offset = _TO_CELSIUS[unit]
        if low * factor + offset >= _USUAL_CELSIUS[0] and high * factor + offset <= _USUAL_CELSIUS[1]:
            return unit
    return COUNTS


def check_filled(values: NDArray[Any], unit: str | None, folder: str, flag: str, *, integer: bool) -> None:
    """Refuse values of which many stand for none: without their lowest or highest they could be temperatures.

    Args:
        values: The values, [N].
        unit: The stated unit; None: usual temperatures of any unit are looked for.
        flag: What says that they are counts.
        integer: The files hold integers.

    Raises:
        UserError: All together they cannot be temperatures, and without that value they can.
    """

    def are_temperatures(some: NDArray[Any]) -> bool:
        ends = value_ends(some)
        return judge_unit(*ends, integer=integer) != COUNTS if unit is None else is_plausible(*ends, unit)

    if unit == COUNTS or are_temperatures(values):
        return
    for end in (values.min(), values.max()):
        filled = values == end
        if not filled.all() and are_temperatures(values[~filled]):
            otherwise = f" If they are measured values of a sensor: {flag}" if unit is None else ""
            raise UserError(
                f"About {filled.mean():.1%} of the values in {folder} are {end:,.6g}, and all others can be "
                "temperatures: these pixels are without a value.",
                "Fill them, export the files again, or say with masks that they do not count (docs/data-layouts.md)."
                + otherwise,
            )


def value_ends(values: NDArray[Any]) -> tuple[float, float]:
    """Low and high end of values [N] without their tails, in which dead pixels are."""
    low, high = (float(end) for end in np.percentile(values, [1, 99]))
    return low, high


def is_plausible(low: float, high: float, unit: str) -> bool:
    """Whether a range of values can be temperatures in a unit."""
    factor, offset = _TO_CELSIUS[unit]
    return low * factor + offset >= _POSSIBLE_CELSIUS[0] and high * factor + offset <= _POSSIBLE_CELSIUS[1]


def check_plausible(low: float, high: float, unit: str, folder: str, spectrum: str) -> None:
    """Refuse a stated unit in which the values are impossible.

    Args:
        low: Low end of the values (a percentile).
        high: High end.

    Raises:
        UserError: The values are outside of what anything measured can be; the hint names the unit they look like.
    """
    if unit == COUNTS or is_plausible(low, high, unit):
        return
    if low == high == 0:
        raise UserError(
            f"Values in {folder} are 0, which read as {unit.capitalize()} is impossible.",
            "Nothing was measured there: export the files again.",
        )
    message = f"Values {low:,.6g}-{high:,.6g} in {folder} read as {unit.capitalize()} are impossible"
    likely = judge_unit(low, high, integer=False)
    if likely == COUNTS:
        raise UserError(f"{message}.", f"If they are raw sensor values without degrees: --{spectrum}.unit counts")
    raise UserError(f"{message}; they look like {likely}.", f"--{spectrum}.unit {likely}")


def read_statement(path: Path, spectrum: str) -> RadiometricStatement:
    """Read a ``units.json``: {"unit": "centikelvin", "palette_min_C": 20, "palette_max_C": 41.5}.

    Args:
        path: The file; may be absent.

    Returns:
        What it states; nothing for a missing file.

    Raises:
        UserError: The file is no JSON object or names an unknown unit.
    """
    if not path.is_file():
        return RadiometricStatement()
    content = read_json(path)
    unit = _unit(content["unit"], path, spectrum) if "unit" in content else None
    span = celsius_range(content, path, "palette_min_C", "palette_max_C")
    return RadiometricStatement(unit, span)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        UserError: The file cannot be read or holds something else.
    """
    try:
        if path.stat().st_size > _LARGEST_JSON:
            raise ValueError(f"it has more than {_LARGEST_JSON:,} bytes")
        content = json.loads(read_regular(path))  # in UTF-8, with a byte-order mark or without, or UTF-16
    except (OSError, ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        reason = getattr(error, "strerror", None) or reason
        raise UserError(f"{path} is not readable JSON: {reason}.", "Restore it, or export it again.") from error
    if not isinstance(content, dict):
        raise UserError(f"{path} must hold a JSON object, found a {type(content).__name__}.", "Is it the right file?")
    return content


def celsius_range(content: dict[str, Any], path: Path, low_key: str, high_key: str) -> tuple[float, float] | None:
    """Two temperatures [°C] of a JSON object, or None where it has neither.

    Raises:
        UserError: One is missing or not a number, or they are the wrong way round.
    """
    if low_key not in content and high_key not in content:
        return None
    try:
        low, high = float(content[low_key]), float(content[high_key])
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(f"not finite: {low}, {high}")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path} must give both {low_key} and {high_key} as numbers [°C].") from error
    if not low < high:
        raise UserError(f"{path}: {low_key} ({low:g}) must be below {high_key} ({high:g}).")
    if low < ABSOLUTE_ZERO or high > _HOTTEST_RANGE:
        raise UserError(
            f"{path}: {low_key} ({low:g}) and {high_key} ({high:g}) must lie between {ABSOLUTE_ZERO:g} and "
            f"{_HOTTEST_RANGE:,.0f} °C.",
            "Are they in °C?",
        )
    return low, high


def _unit(stated: Any, path: Path, spectrum: str) -> str:
    """A unit by its name, in any usual spelling."""
    unit = unit_named(stated) if isinstance(stated, str) else None
    if unit not in _TO_CELSIUS and unit != COUNTS:
        known = ", ".join((*_TO_CELSIUS, COUNTS))
        raise UserError(
            f"{path} names the unit {shown(stated)}; known are {known}.", f"Or say it with --{spectrum}.unit."
        )
    return unit
