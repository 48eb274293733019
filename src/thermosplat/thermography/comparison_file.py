"""changes.json of a comparison: which runs it is of, how they lie in each other's frame, and what changed.

    {"format": "thermosplat-comparison", "version": 1, "first": "march", "run": "results/march", "spectrum": "thermal",
     "unit": "celsius", "length_unit": "m", "times": ["2026-03-01T10:02:27", ...],
     "dates": [{"name": "june", "run": "results/june", "shift": 2.1,
     "shift_plus_minus": 0.5, "span": 3.0, "to_first": [[r, r, r, t], ...], "changes": [{"kind": "warmer", ...}]}]}

``to_first`` takes the scene of a later date to that of the first. ``times`` are those of all dates, null where files do
not state them.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.runs.documents import read_document

COMPARISON_FILE = "changes.json"
WHAT, VERSION = "comparison", 1
_HINT = "Run thermosplat-compare BEFORE AFTER --output FOLDER, and name that folder."
_MOST, _LONGEST = 10_000, 2000
KINDS = ("warmer", "colder", "gone", "new", "moved")
PICTURED = 60
"""Changes with a picture."""


def plan_picture(date: int) -> str:
    """File of the differences of a date with its changes numbered, in the folder."""
    return f"pictures/difference_{date}.png"


def change_picture(date: int, number: int) -> str:
    """File of a change at both dates, in the folder."""
    return f"pictures/change_{date}_{number:03}.png"


@dataclass(frozen=True)
class KnownChange:
    """A place that changed."""

    number: int
    kind: str
    place: tuple[float, float]
    """East and north."""
    area: float
    difference: float
    plus_minus: float
    height: float


@dataclass(frozen=True, eq=False)
class LaterDate:
    """A date that was compared with the first."""

    number: int
    """From 1 on."""
    name: str
    run: Path
    to_first: NDArray[np.float64]
    """[3, 4]."""
    shift: float
    """What all values changed by."""
    shift_plus_minus: float
    span: float
    """Difference at either end of the palette."""
    changes: tuple[KnownChange, ...]


@dataclass(frozen=True)
class KnownComparison:
    """A comparison that was made."""

    folder: Path
    first: str
    """Name of the first date."""
    run: Path
    """Its run."""
    spectrum: str
    unit: str
    length_unit: str
    dates: tuple[LaterDate, ...]

    def of(self, run: Path) -> LaterDate:
        """The date of a run.

        Args:
            run: Its folder.

        Raises:
            UserError: It is none of the later dates.
        """
        found = [date for date in self.dates if date.run.resolve() == run.resolve()]
        if not found:
            raise UserError(
                f"{self.folder} compares {self.run} with {', '.join(str(date.run) for date in self.dates)}, "
                f"and {run} is none of the later ones.",
                f"Name one of them, or compare it: thermosplat-compare {self.run} {run}",
            )
        return found[-1]


def read_comparison(folder: Path) -> KnownComparison:
    """The comparison in a folder.

    Args:
        folder: ``--output`` of thermosplat-compare.

    Raises:
        UserError: There is none, or it cannot be read.
    """
    path = folder / COMPARISON_FILE
    content = read_document(path, WHAT, VERSION, _HINT)
    try:
        dates = tuple(_date(number, stated) for number, stated in enumerate(content["dates"], 1))
        first, run, spectrum, unit, length = (
            str(content[name])[:_LONGEST] for name in ("first", "run", "spectrum", "unit", "length_unit")
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} has no comparison that can be read.", _HINT) from error
    return KnownComparison(folder, first, Path(run), spectrum, unit, length, dates)


def _date(number: int, stated: Any) -> LaterDate:
    matrix = np.array(stated["to_first"], np.float64).reshape(3, 4)
    if not (np.isfinite(matrix).all() and np.linalg.det(matrix[:, :3]) > 0):
        raise ValueError("no similarity")
    shift, sure, span = (_number(stated[name]) for name in ("shift", "shift_plus_minus", "span"))
    changes = tuple(_change(one) for one in stated["changes"][:_MOST])
    name, run = (str(stated[key])[:_LONGEST] for key in ("name", "run"))
    return LaterDate(number, name, Path(run), matrix, shift, sure, span, changes)


def _change(stated: Any) -> KnownChange:
    east, north, *others = (
        _number(stated[name]) for name in ("east", "north", "area", "difference", "plus_minus", "height")
    )
    if stated["kind"] not in KINDS:
        raise ValueError("another kind of change")
    return KnownChange(int(stated["number"]), stated["kind"], (east, north), *others)


def _number(stated: Any) -> float:
    if not math.isfinite(number := float(stated)):
        raise ValueError("no number")
    return number
