"""What is said of two flights in one folder, and of photographs without GPS."""

from dataclasses import replace

import numpy as np
import pytest

from flown_model import flight, rows_at
from thermosplat.prepare.structure.flights import remarks
from thermosplat.prepare.structure.positions import positions_of


def said(rows: list, registered: slice = slice(None)) -> list[str]:
    return remarks(rows, positions_of(rows, {}), {f"rgb/{row.file}" for row in rows[registered]})


def test_nothing_is_said_of_one_flight() -> None:
    """Nor of one with a strip missing, of photographs without GPS, or of a change of batteries."""
    rows = flight().rows
    times = [
        f"2026-06-12T10:{number:02}:00" if number < 20 else f"2026-06-12T11:{number:02}:00" for number in range(40)
    ]
    rows = [replace(row, time=time) for row, time in zip(rows, times)]
    assert said(rows) == said(rows[:16] + rows[24:]) == []
    assert said([replace(row, latitude=None) for row in rows]) == []


def test_two_places_in_one_folder_are_told_apart() -> None:
    """Where the smaller one has no poses; not where one model holds both."""
    places = flight().places
    places[24:] += [1200.0, 0.0, 0.0]
    rows = rows_at(places)
    assert said(rows) == []
    (sentence,) = said(rows, slice(24))
    assert "at 2 places, 1,2" in sentence
    assert "24 with 001.jpg and 16 with 025.jpg" in sentence
    assert "prepare each from a folder of its own" in sentence


def test_two_dates_in_one_folder_are_told() -> None:
    """46 days lie between them, with zones or without."""
    rows = flight().rows
    rows = [
        replace(row, time=f"2026-06-12T10:{number:02}:00" if number < 20 else f"2026-07-28T10:{number:02}:00+02:00")
        for number, row in enumerate(rows)
    ]
    (sentence,) = said(rows)
    assert sentence.startswith("! The photographs are of 2 flights: between 020.jpg and 021.jpg lie 46 days.")


@pytest.mark.parametrize("count", [1, 3])
def test_photographs_without_a_position_are_named(count: int) -> None:
    """With how they were matched."""
    places = flight().places
    places[:count] = np.nan
    (sentence,) = said(rows_at(places))
    assert sentence.startswith(f"{count} of 40 photographs {'has' if count == 1 else 'have'} no GPS position (001.jpg")
    assert "matched by looks and names" in sentence
