"""Values of all dates at the places that changed, and at the measurements of the first date."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermosplat.comparison.changes import Changes
from thermosplat.comparison.dated_map import Date, DatedMap
from thermosplat.thermography.measurements import Definition
from thermosplat.thermography.measurements_file import FOLDER, MEASUREMENTS, read_book
from thermosplat.viewer.layers import LayerRenderer
from thermosplat.viewer.measuring import Measurer
from thermosplat.viewer.viewed_scene import ViewedScene


@dataclass(frozen=True)
class Row:
    """One place or measurement."""

    what: str
    values: tuple[float | None, ...]
    """Its mean at each date; None where it has none."""
    unit: str = ""
    """Of the values, for people; "": none."""

    @property
    def title(self) -> str:
        """What it is, with the unit."""
        return f"{self.what} [{self.unit}]" if self.unit else self.what


def over_time(dates: Sequence[Date], maps: Sequence[DatedMap], changes: Sequence[Changes], unit: str) -> list[Row]:
    """One row for each place whose temperature changed, then one for each measurement.

    A place that changed at several dates has one row, under its first name.

    Args:
        unit: Of the maps' values, for people.
    """
    rows, places = [], list[NDArray[np.bool_]]()
    for date, found in zip(dates[1:], changes):
        for number, change in enumerate(found.found, 1):
            # the same place is one of which two changes overlap by half or more of what either covers
            known = any(2 * (change.mask & one).sum() >= (change.mask | one).sum() for one in places)
            if change.kind in ("warmer", "colder") and not known:
                means = tuple(_mean(one.values, change.mask) for one in maps)
                rows.append(Row(f"{date.name} {number}, {change.kind}", means, unit))
                places.append(change.mask)
    return [*rows, *_measurements(dates)]


def _mean(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> float | None:
    known = values[mask & np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _measurements(dates: Sequence[Date]) -> list[Row]:
    """The measurements of the first date's run, measured again at every date from the same standpoints."""
    file = dates[0].run.directory.path / FOLDER / MEASUREMENTS
    if not file.is_file():
        return []
    _, definitions = read_book(file)
    measurers = [Measurer(LayerRenderer(_viewed(date))) for date in dates]
    rows = []
    for definition in definitions:
        numbers = [measurer.measure(_moved(definition, dates[0], date)) for date, measurer in zip(dates, measurers)]
        unit = next((one.unit for one in numbers if one is not None), "")
        rows.append(Row(definition.name, tuple(None if one is None else one.mean for one in numbers), unit))
    return rows


def _viewed(date: Date) -> ViewedScene:
    run = date.run
    return ViewedScene(
        date.name, run.model, run.sh_degree, dict(run.scales), run.device, date.capture, run.temperatures()
    )


def _moved(definition: Definition, first: Date, other: Date) -> Definition:
    """A definition whose standpoint is in the world of another date."""
    view = first.run.model.placement.viewmat_to_scene(definition.standpoint.viewmat)
    world = other.run.model.placement.viewmat_to_world(other.to_first.viewmat_to_scene(view))
    return replace(definition, standpoint=replace(definition.standpoint, viewmat=world))
