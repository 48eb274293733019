"""Measurements are kept: unique names, renamed, deleted, undone, compared, and found again after a restart."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.thermography.measurement_book import MeasurementBook
from thermosplat.thermography.measurements import Alarm, Definition, Measurement, Seen, Standpoint, measure
from thermosplat.thermography.measurements_file import read_book, read_scale

FIELD = np.arange(60, dtype=np.float32).reshape(6, 10)
VIEW = Standpoint(np.eye(4), 50.0, 10, 6)
SEEN = Seen(FIELD, np.full((6, 10), 2.0), "temperature", "°C", 2)


def made(shape="spot", places=((2.5, 1.5),), **changes: object) -> Measurement:
    definition = replace(Definition("", shape, "image", "thermal", VIEW, places), **changes)
    numbers = measure(definition, SEEN)
    assert numbers is not None
    return Measurement(definition, numbers)


def test_an_area_has_the_numbers_of_its_pixels() -> None:
    """Minimum, maximum, mean and deviation are numpy's; the extremes are marked where they are."""
    part, found = FIELD[1:4, 2:5], made("rectangle", ((2.0, 1.2), (4.5, 3.6)))
    numbers = found.numbers
    assert (numbers.minimum, numbers.maximum, numbers.mean, numbers.count) == (part.min(), part.max(), part.mean(), 9)
    assert numbers.std == pytest.approx(part.std())
    assert (numbers.minimum_px, numbers.maximum_px) == ((2.5, 1.5), (4.5, 3.5))
    assert found.text == "23.00 °C (12.00 to 34.00, std 8.21)"


def test_pixels_without_a_value_do_not_count() -> None:
    """NaNs are left out, and where there is nothing else there is no measurement."""
    field = FIELD.copy()
    field[:, :5] = np.nan
    seen = replace(SEEN, values=field)
    area = made("rectangle", ((0.0, 0.0), (9.9, 0.6))).definition
    assert (measure(area, seen).minimum, measure(area, seen).count) == (5.0, 5)
    assert measure(made().definition, seen) is None


def test_names_are_unique(tmp_path: Path) -> None:
    """A name is never given twice; a new one must be free."""
    book = MeasurementBook(tmp_path / "measurements.json")
    assert [book.add(made()).name for _ in range(2)] == ["S1", "S2"]
    assert book.add(made("line", ((0.5, 0.5), (8.5, 0.5)))).name == "L1"
    book.rename("S1", "window")
    assert book.add(made()).name == "S3"
    with pytest.raises(UserError, match="Another measurement is called window"):
        book.rename("S2", "window")
    for wrong in ("", "x" * 41, "<b>"):
        with pytest.raises(UserError, match="cannot be a name"):
            book.rename("S2", wrong)
    with pytest.raises(UserError, match="No measurement is called S9"):
        book.delete("S9")


def test_everything_survives_a_restart(tmp_path: Path) -> None:
    """Numbers to the last digit, alarms, settings, differences, the scale."""
    path = tmp_path / "measurements.json"
    book = MeasurementBook(path)
    book.add(made(alarm=Alarm("between", 5.0, 20.0), settings={"emissivity": 0.9}))
    book.add(made("spot", ((7.5, 4.5),)))
    book.add(made("line", ((0.5, 0.5), (8.5, 0.5))))
    book.compare("S2", "S1")
    book.set_scale("L1", 4.0)
    pages, definitions = read_book(path)
    assert [one.numbers for one in pages.measurements] == [one.numbers for one in book.pages.measurements]
    assert pages.measurements[0].definition.alarm == Alarm("between", 5.0, 20.0)
    assert definitions[0].settings == {"emissivity": 0.9}
    assert pages.difference("S2", "S1") == (35.0, "K")
    assert pages.differences == (("S2", "S1"),)
    length = pages.by_name["L1"].numbers.length
    assert pages.metres_per_unit * length == pytest.approx(4.0)
    assert read_scale(path) == pages.metres_per_unit
    assert pages.by_name["L1"].extent_text(pages.metres_per_unit) == "4 m"
    assert MeasurementBook(path, pages).add(made()).name == "S3"


def test_undo_takes_back_each_change(tmp_path: Path) -> None:
    """Also a deletion, with the differences that went with it; the file follows."""
    path = tmp_path / "measurements.json"
    book = MeasurementBook(path)
    book.add(made()), book.add(made("spot", ((7.5, 4.5),)))
    book.compare("S1", "S2")
    book.rename("S1", "door")
    book.delete("door")
    assert book.pages.differences == ()
    assert book.undo()
    assert read_book(path)[0].differences == (("door", "S2"),)
    assert [book.undo() for _ in range(5)] == [True, True, True, True, False]
    assert read_book(path)[0].measurements == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(format="other"), "no .*thermosplat-measurements"),
        (lambda content: content["measurements"][0].update(shape="blob"), "measurement 1: blob is no shape"),
        (lambda content: content["measurements"][0].update(places_px=[]), "measurement 1 is none .*1 to 1 places"),
        (lambda content: content["measurements"][0]["view"].update(width=10**9), "view is no picture"),
        (lambda content: content["measurements"][0]["view"].update(viewmat=[[1]]), "measurement 1 is none"),
        (lambda content: content["measurements"][0].update(settings={"emissivity": 7}), "emissivity must be"),
        (lambda content: content["measurements"][0]["numbers"].update(mean="x"), "measurement 1 is none"),
        (lambda content: content["measurements"].append(content["measurements"][0]), "two measurements .* called S1"),
        (lambda content: content.update(metres_per_unit=-1), "metres_per_unit must be a length"),
        (lambda content: content.update(settings={"colour": 1}), "has the setting colour"),
    ],
)
def test_damaged_files(tmp_path: Path, change, message: str) -> None:
    """One sentence names the file, the measurement and what is wrong with it."""
    path = tmp_path / "measurements.json"
    MeasurementBook(path).add(made())
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        read_book(path)


def test_a_file_without_numbers_is_a_list_of_wishes(tmp_path: Path) -> None:
    """A person may write the definitions alone."""
    path = tmp_path / "measurements.json"
    MeasurementBook(path).add(made())
    content = json.loads(path.read_text())
    del content["measurements"][0]["numbers"]
    path.write_text(json.dumps(content))
    pages, (definition,) = read_book(path)
    assert pages.measurements == ()
    assert (definition.name, definition.places) == ("S1", ((2.5, 1.5),))
