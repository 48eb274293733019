"""What positions and times say of a flight that its poses cannot: parts that lie apart, days that do not agree."""

from collections.abc import Collection, Sequence
from datetime import datetime, timedelta
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.capture_folder import LEADING, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.structure.positions import Positions
from thermosplat.prepare.structure.unregistered import some

_APART, _APART_METRES = 10.0, 50.0
"""Parts lie apart where the way between them is so many times the usual one, and so long [m]. Open choice."""
_LEAST_PART = 3
"""Photographs of a part; fewer have wrong positions."""
_PAUSE = timedelta(hours=3)
"""Batteries are changed in minutes; in three hours the sun moves by 45°. Open choice."""


def remarks(photographs: Sequence[FrameRow], positions: Positions, registered: Collection[str]) -> list[str]:
    """Sentences on a flight; none of pictures without positions and times.

    Args:
        positions: Their positions, in the same order.
    """
    said = []
    without = [row.file for row, known in zip(photographs, positions.known) if not known]
    if without and len(without) < len(photographs):
        said.append(
            f"{len(without)} of {counted(len(photographs), 'photograph')} {agreeing(len(without), 'has', 'have')} no "
            f"GPS position ({some(without)}); "
            f"{agreeing(len(without), 'it was', 'they were')} matched by looks and names."
        )
    return [*said, *_places(photographs, positions, registered), *_pauses(photographs)]


def _places(photographs: Sequence[FrameRow], positions: Positions, registered: Collection[str]) -> list[str]:
    """Of parts far from one another, if one of them is not in the model."""
    known = np.flatnonzero(positions.known)
    parts = [known[part] for part in _parts(positions.places[known])]
    lost = [part for part in parts if not any(f"{LEADING}/{photographs[i].file}" in registered for i in part)]
    if len(parts) < 2 or not lost:
        return []
    middles = [np.median(positions.places[part], axis=0) for part in parts[:2]]
    apart = np.linalg.norm(middles[1] - middles[0])
    return [
        f"! By GPS, photographs were taken at {len(parts)} places, {apart:,.0f} m apart "
        f"({' and '.join(f'{len(part)} with {photographs[part[0]].file}' for part in parts)}), and one model does not "
        "hold them. If these are several flights, prepare each from a folder of its own."
    ]


def _parts(places: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Places [N, 3] in parts, the largest first: a shortest tree through all of them, cut where it is far too long."""
    count = len(places)
    if count < 2 * _LEAST_PART:
        return [np.arange(count)]
    part, away, source, reached = (
        np.zeros(count, int),
        np.full(count, np.inf),
        np.zeros(count, int),
        np.zeros(count, bool),
    )
    edges, last = [], 0
    for _ in range(count - 1):
        reached[last] = True
        distances = np.linalg.norm(places - places[last], axis=1)
        source = np.where(distances < away, last, source)
        away = np.minimum(away, distances)
        nearest = int(np.where(reached, np.inf, away).argmin())
        edges.append((int(source[nearest]), nearest, float(away[nearest])))
        last = nearest
    longest = max(_APART_METRES, _APART * float(np.median([length for _, _, length in edges])))
    number = 0
    for one, other, length in edges:  # each edge leads from what was reached to what was not
        number += length > longest
        part[other] = number if length > longest else part[one]
    found = [np.flatnonzero(part == label) for label in range(number + 1)]
    return sorted((one for one in found if len(one) >= _LEAST_PART), key=len, reverse=True)


def _pauses(photographs: Sequence[FrameRow]) -> list[str]:
    """Of a long pause between photographs."""
    taken = sorted((time, row.file) for row in photographs if (time := _moment(row.time)) is not None)
    pauses = [(after[0] - before[0], before, after) for before, after in pairwise(taken)]
    long = [pause for pause in pauses if pause[0] > _PAUSE]
    if not long:
        return []
    pause, before, after = max(long)
    hours = pause.total_seconds() / 3600
    length = f"{hours:.0f} hours" if hours < 48 else f"{hours / 24:.0f} days"
    return [
        f"! The photographs are of {len(long) + 1} flights: between {before[1]} and {after[1]} lie {length}. "
        "Things have other temperatures by then, and one scene would have their mean. Prepare each flight from a "
        "folder of its own."
    ]


def _moment(time: str | None) -> datetime | None:
    """A time without its zone, by which photographs of one camera do not differ."""
    try:
        return None if time is None else datetime.fromisoformat(time).replace(tzinfo=None)
    except ValueError:
        return None
