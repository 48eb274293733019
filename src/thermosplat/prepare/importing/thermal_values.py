"""Thermal files into 16-bit values with a unit.

Temperatures become hundredths of a kelvin, which reach 382 °C, or tenths of one where a capture is hotter. Sensor
counts stay as they are, unless the user says what they mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import ImagePixels, read_pixels
from thermosplat.errors import UserError
from thermosplat.prepare.importing.source_files import SourceFile
from thermosplat.spectra import COUNTS
from thermosplat.thermal.planck_counts import ZERO_CELSIUS
from thermosplat.thermal.temperature_units import (
    check_filled,
    check_plausible,
    judge_unit,
    measured_unit,
    read_statement,
    to_measured,
)

StoredUnit = Literal["centikelvin", "decikelvin", "counts"]
STEPS_PER_KELVIN = {"centikelvin": 100.0, "decikelvin": 10.0}
"""Stored levels per kelvin of each unit with degrees."""
_SAMPLED = 6
_MOST_DEAD = 0.01
"""Share of pixels without a value that is filled from their neighbours; more is an error."""


class TooHot(Exception):
    """Temperatures that do not fit into 16 bits of hundredths of a kelvin."""


@dataclass(frozen=True)
class Meaning:
    """What the stored values of thermal files mean.

    Args:
        unit: Unit of a value after scale and offset; "counts" for none.
        scale: What a stored value is multiplied by.
        offset: What is added then.
        stated: The user, the capture or the format says so; else it is judged by the values.
    """

    unit: str
    scale: float = 1.0
    offset: float = 0.0
    stated: bool = False

    def celsius(self, values: NDArray[Any]) -> NDArray[np.float64] | None:
        """Temperatures [°C] of stored values; None for counts."""
        measured = to_measured(values.astype(np.float64) * self.scale + self.offset, self.unit)
        return None if measured is None else measured.astype(np.float64)


def choose_meaning(files: Sequence[SourceFile], unit: str | None, scale: float | None, offset: float | None) -> Meaning:
    """What the values of a capture's thermal files mean.

    Args:
        unit: The user's word on the unit after scale and offset, or None.
        scale: The user's word, or None for 1.
        offset: The user's word, or None for 0.

    Raises:
        UserError: Scale and offset without a unit, for files that state temperatures themselves, or an impossible unit.
    """
    if files[0].kind in ("flir", "dji"):
        if (unit, scale, offset) != (None, None, None):
            raise UserError(
                f"{files[0].name} holds its own calibration, so --unit, --scale and --offset are not for it.",
                "Leave these flags out.",
            )
        return Meaning("celsius", stated=True)
    if unit is None and (scale, offset) != (None, None):
        raise UserError(
            "--scale and --offset need the unit of what they give.", "For temperatures in °C add --unit celsius."
        )
    sampled = [read_pixels(file.path) for file in files[:: -(-len(files) // _SAMPLED)]]
    sample = np.concatenate([pixels.image[::4, ::4][~without_value(pixels)[::4, ::4]] for pixels in sampled])
    if sample.size == 0:
        raise UserError(f"{files[0].path} and others like it hold no numbers.", "Export them again.")
    stored = [float(end) for end in np.percentile(sample, [1, 99])]
    if unit is not None:
        meaning = Meaning(unit, 1.0 if scale is None else scale, 0.0 if offset is None else offset, stated=True)
        low, high = sorted(end * meaning.scale + meaning.offset for end in stored)
        check_plausible(low, high, meaning.unit, f"{files[0].path.parent.name}/", "thermal")
        return meaning
    statement = read_statement(files[0].path.parent / "units.json", "thermal").unit
    if statement is not None:
        return Meaning(statement, stated=True)
    integer = sample.dtype.kind in "iu"
    check_filled(sample, None, f"{files[0].path.parent.name}/", "--unit counts", integer=integer)
    return Meaning(judge_unit(*stored, integer=integer))


def levels_of(path: Path, celsius: NDArray[Any], unit: StoredUnit) -> tuple[NDArray[np.uint16], int]:
    """Temperatures as they are stored in a capture.

    Args:
        celsius: [H, W] [°C]; NaN, or absolute zero and below, where there is none.

    Returns:
        uint16 [H, W], and how many pixels had no value and got that of their neighbours.

    Raises:
        TooHot: A temperature does not fit into the unit.
        UserError: Too many pixels have no value.
    """
    dead = ~np.isfinite(celsius) | (celsius <= -ZERO_CELSIUS)
    _check_dead(path, dead)
    count = int(dead.sum())
    filled = _filled(celsius, dead) if count else celsius
    levels = np.rint((filled + ZERO_CELSIUS) * STEPS_PER_KELVIN[unit])
    if levels.max() > np.iinfo(np.uint16).max:
        if unit == "centikelvin":
            raise TooHot
        raise UserError(f"{path} has temperatures up to {filled.max():,.0f} °C.", "Is the unit right? See --unit.")
    return levels.astype(np.uint16), count


def without_value(pixels: ImagePixels) -> NDArray[np.bool_]:
    """Where a file has no value, bool [H, W]: it is no number, or the file calls it NoData or transparent."""
    void = ~np.isfinite(pixels.image)
    if pixels.void is not None:
        void |= pixels.void
    return void if pixels.mask is None else void | ~pixels.mask


def _check_dead(path: Path, dead: NDArray[np.bool_]) -> None:
    count = int(dead.sum())
    if count > _MOST_DEAD * dead.size:
        raise UserError(
            f"{path} has {count:,} of {dead.size:,} pixels without a temperature.",
            "Export the file again, or leave it out.",
        )


def counts_of(path: Path) -> tuple[NDArray[np.uint16], int]:
    """The counts of a file without degrees, uint16 [H, W], and how many pixels had none and got their neighbours'.

    Raises:
        UserError: They are neither 16-bit counts nor temperatures in a unit that can be told, or too many are none.
    """
    pixels = read_pixels(path)
    stored, void = pixels.image, without_value(pixels)
    _check_dead(path, void)
    count = int(void.sum())
    if count:
        stored = np.where(void, np.rint(_filled(stored, void)), stored).astype(stored.dtype)
    if stored.dtype == np.uint16:
        return stored, count
    if (stored != np.rint(stored)).any() or stored.min() < 0 or stored.max() > 65535:
        raise UserError(
            f"{path} holds values {stored.min():,.6g} to {stored.max():,.6g} that are neither "
            "temperatures in a unit that can be told, nor 16-bit counts.",
            "Say what they are: --unit celsius or kelvin, perhaps with --scale and --offset.",
        )
    return stored.astype(np.uint16), count


def _filled(values: NDArray[Any], dead: NDArray[np.bool_]) -> NDArray[Any]:
    """Dead pixels take the median of the 5x5 pixels around them."""
    whole = np.where(dead, np.median(values[~dead]), values).astype(np.float32)
    return np.where(dead, cv2.medianBlur(whole, 5), values)


def unit_sentence(meaning: Meaning, file: SourceFile) -> str:
    """What the values of plain files, such as this one, were taken for, in words."""
    if meaning.unit == COUNTS:
        hint = ""
        if (file.exif.make or "").lower().startswith("workswell"):
            hint = " Workswell's usual convention, unverified here, is --unit celsius --scale 0.025 --offset -100."
        stated = "" if meaning.stated else "; their unit could not be told"
        return f"Thermal values are sensor counts without degrees{stated}. --unit, --scale and --offset say more.{hint}"
    how = "as stated" if meaning.stated else "judged by the values; --unit says otherwise"
    degrees = measured_unit(meaning.unit)
    return f"Thermal values were read as {meaning.unit} ({how}) and are kept as {degrees and 'temperatures'}."
