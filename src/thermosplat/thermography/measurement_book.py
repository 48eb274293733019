"""All measurements of a run: unique names, renaming, deleting, undoing, differences; kept in a file at each change."""

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.thermography.measurements import Definition, Measurement
from thermosplat.thermography.shapes import LETTERS

MOST_MEASUREMENTS = 500
"""Of a run: more make the page slow."""
_MOST_UNDONE = 50
_NAME = re.compile(r"[\w .,()+-]{1,40}", re.UNICODE)


@dataclass(frozen=True)
class Pages:
    """What a book holds at a moment."""

    measurements: tuple[Measurement, ...] = ()
    """In the order in which they were made."""
    differences: tuple[tuple[str, str], ...] = ()
    """Pairs of names: the first one's mean minus the second one's."""
    metres_per_unit: float | None = None
    """Length of a world unit [m], as a measured line says; None: nobody has said it."""
    settings: dict[str, float] = field(default_factory=dict)
    """What temperatures of the scene are recalculated with, by the names of ``TemperatureSettings``."""

    @property
    def by_name(self) -> dict[str, Measurement]:
        """The measurements by name."""
        return {one.name: one for one in self.measurements}

    def difference(self, first: str, second: str) -> tuple[float, str] | None:
        """ΔT of two measurements' means and its unit; None where one is gone or they measure different things."""
        one, other = self.by_name.get(first), self.by_name.get(second)
        if one is None or other is None or one.numbers.unit != other.numbers.unit:
            return None
        unit = "K" if one.numbers.unit == "°C" else one.numbers.unit
        return one.numbers.mean - other.numbers.mean, unit


class MeasurementBook:
    """Measurements that change; safe to use from several threads.

    Args:
        path: Where they are kept; None: nowhere.
        pages: What there is already.
    """

    def __init__(self, path: Path | None = None, pages: Pages | None = None) -> None:
        self.path = path
        self._pages = pages or Pages()
        self._earlier: list[Pages] = []
        self._lock = threading.RLock()
        self.heard: list[Callable[[], None]] = []
        """Called after each change."""

    @property
    def pages(self) -> Pages:
        """What there is now."""
        return self._pages

    def add(self, made: Measurement) -> Measurement:
        """Keep a measurement; it gets the next free name of its shape where it has none.

        Raises:
            UserError: There are too many.
        """
        with self._lock:
            if len(self._pages.measurements) >= MOST_MEASUREMENTS:
                raise UserError(f"There are {MOST_MEASUREMENTS} measurements already.", "Delete some.")
            if not made.name or made.name in self._pages.by_name:
                made = replace(made, definition=replace(made.definition, name=self._free_name(made.definition)))
            self._change(replace(self._pages, measurements=(*self._pages.measurements, made)))
            return made

    def rename(self, name: str, new: str) -> None:
        """Call a measurement something else.

        Raises:
            UserError: There is no such one, or the new name is another one's or none.
        """
        with self._lock:
            one, new = self._named(name), new.strip()
            if not _NAME.fullmatch(new):
                raise UserError(
                    f"{new!r} cannot be a name.", "Give one of 1 to 40 letters, digits, spaces and . , ( ) + - signs."
                )
            if new != name and new in self._pages.by_name:
                raise UserError(f"Another measurement is called {new}.", "Give a name that is free.")
            renamed = replace(one, definition=replace(one.definition, name=new))
            pairs = tuple((new if a == name else a, new if b == name else b) for a, b in self._pages.differences)
            self._change(replace(self._pages, measurements=self._with(name, renamed), differences=pairs))

    def replace(self, name: str, other: Measurement) -> None:
        """Put another measurement in the place of one: its numbers, alarm or settings have changed."""
        with self._lock:
            self._named(name)
            self._change(replace(self._pages, measurements=self._with(name, other)))

    def renumber(self, measurements: Sequence[Measurement], settings: dict[str, float]) -> None:
        """Give measurements that are still there the numbers that other settings of the scene make."""
        with self._lock:
            known = {one.name: one for one in measurements}
            again = tuple(known.get(one.name, one) for one in self._pages.measurements)
            self._change(replace(self._pages, measurements=again, settings=settings))

    def delete(self, name: str) -> None:
        """Forget a measurement, and the differences that it is in.

        Raises:
            UserError: There is no such one.
        """
        with self._lock:
            self._named(name)
            kept = tuple(one for one in self._pages.measurements if one.name != name)
            pairs = tuple(pair for pair in self._pages.differences if name not in pair)
            self._change(replace(self._pages, measurements=kept, differences=pairs))

    def compare(self, first: str, second: str) -> None:
        """Keep the difference of two measurements.

        Raises:
            UserError: One is not there, or they measure different things.
        """
        with self._lock:
            self._named(first), self._named(second)
            if first == second or self._pages.difference(first, second) is None:
                raise UserError(f"{first} and {second} have no difference.", "Give two measurements of one unit.")
            if (first, second) not in self._pages.differences:
                self._change(replace(self._pages, differences=(*self._pages.differences, (first, second))))

    def set_scale(self, name: str, metres: float) -> None:
        """Say how long a line is.

        Args:
            name: A line.
            metres: Its length [m].

        Raises:
            UserError: It is no line on the scene, or the length is impossible.
        """
        with self._lock:
            length = self._named(name).numbers.length
            if not length or not 0 < metres < 1e6:
                raise UserError(
                    f"{name} cannot tell the scene's scale.", "Measure a line, and type its length in metres."
                )
            self._change(replace(self._pages, metres_per_unit=metres / length))

    def undo(self) -> bool:
        """Take the last change back; whether there was one."""
        with self._lock:
            if not self._earlier:
                return False
            self._pages = self._earlier.pop()
            self._tell()
            return True

    def _free_name(self, definition: Definition) -> str:
        letter = LETTERS[definition.shape]
        numbers = (name[1:] for name in self._pages.by_name if name[:1] == letter and name[1:].isdecimal())
        return f"{letter}{1 + max(map(int, numbers), default=0)}"

    def _named(self, name: str) -> Measurement:
        found = self._pages.by_name.get(name)
        if found is None:
            raise UserError(f"No measurement is called {name}.", f"There are: {', '.join(self._pages.by_name)}.")
        return found

    def _with(self, name: str, other: Measurement) -> tuple[Measurement, ...]:
        return tuple(other if one.name == name else one for one in self._pages.measurements)

    def _change(self, pages: Pages) -> None:
        self._earlier = [*self._earlier, self._pages][-_MOST_UNDONE:]
        self._pages = pages
        self._tell()

    def _tell(self) -> None:
        if self.path is not None:
            from thermosplat.thermography.measurements_file import write_book  # which reads books

            write_book(self.path, self._pages)
        for listener in list(self.heard):
            listener()
