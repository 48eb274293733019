"""thermosplat-measure: the numbers of the viewer and of Python, without a browser."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from sample_runs import Run
from thermosplat.cli import measure
from thermosplat.thermography.measurement_book import MeasurementBook, Pages
from thermosplat.thermography.measurements import Alarm
from thermosplat.thermography.measurements_file import read_book
from thermosplat.viewer.layers import Layer, LayerRenderer
from thermosplat.viewer.measuring import Measurer
from thermosplat.viewer.opening import open_scene
from thermosplat.viewer.session import ViewSession
from thermosplat.viewer.turns import OneAtATime
from thermosplat.viewer.wish import Wish


def test_viewer_command_and_python_agree(run: Run, finished: Path, tmp_path: Path) -> None:
    """What a session measured and kept: the same numbers to the last digit, with the same emissivity."""
    scene, folder, _ = open_scene(str(finished), device="cpu")
    path = folder / "measurements.json"
    book = MeasurementBook(path)
    session = ViewSession(LayerRenderer(scene), OneAtATime(), Wish(*[Layer("image", "thermal")] * 2), book=book)
    session.render(scene.start(), 64, 48)
    for shape, places in {
        "spot": [(0.5, 0.5)],
        "line": [(0.2, 0.4), (0.8, 0.6)],
        "rectangle": [(0.3, 0.3), (0.6, 0.6)],
        "ellipse": [(0.3, 0.3), (0.7, 0.8)],
        "polygon": [(0.1, 0.1), (0.8, 0.2), (0.5, 0.9)],
    }.items():
        assert session.measure(shape, places) is not None
    session.measure_again("R1", alarm=Alarm("above", 20.0), settings={"emissivity": 0.8})
    book.compare("R1", "E1")
    book.set_scale("L1", 1.5)
    seen = book.pages
    code, printed = run(measure.main, finished, path, "--device", "cpu", "--output", tmp_path)
    assert code == 0
    assert "R1 - E1" in printed
    commanded, definitions = read_book(tmp_path / "measured.json")
    again = Measurer(LayerRenderer(scene)).again(Pages(), definitions)
    for one in seen.measurements:
        assert commanded.by_name[one.name].numbers == one.numbers == again.by_name[one.name].numbers
    assert commanded.metres_per_unit == seen.metres_per_unit
    rows = list(csv.DictReader((tmp_path / "measured.csv").open(encoding="utf-8")))
    assert [row["name"] for row in rows] == ["S1", "L1", "R1", "E1", "P1", "R1 - E1"]
    assert float(rows[1]["length_m"]) == pytest.approx(1.5)
    assert float(rows[2]["area_m2"]) > 0
    code, printed = run(measure.main, finished, path, "--device", "cpu", "--output", tmp_path, "--emissivity", 0.7)
    assert code == 0
    recalculated = read_book(tmp_path / "measured.json")[0]
    assert recalculated.by_name["S1"].numbers.recalculated == "recalculated: emissivity 0.7"
    assert recalculated.by_name["S1"].numbers.mean != seen.by_name["S1"].numbers.mean
    assert recalculated.by_name["R1"].numbers == seen.by_name["R1"].numbers
    path.unlink()


def test_regions_of_the_scene(run: Run, finished: Path, tmp_path: Path) -> None:
    """A list with place, extent and extreme, and the frame to look at each from; a measurements.json is not needed."""
    words = [finished, "--device", "cpu", "--output", tmp_path]
    code, printed = run(measure.main, *words, "--above", 25)
    assert code == 0
    written = json.loads((tmp_path / "regions.json").read_text())
    assert written["regions"]
    assert f"{len(written['regions'])} regions" in printed
    first = written["regions"][0]
    assert first["extreme"] > 25
    assert len(first["place"]) == 3
    assert first["frame"]
    assert run(measure.main, *words, "--above", 1000)[0] == 0
    assert json.loads((tmp_path / "regions.json").read_text())["regions"] == []


def test_mistakes(run: Run, finished: Path, tmp_path: Path) -> None:
    """No file, another layer than the scene has, two thresholds: one sentence each."""
    code, printed = run(measure.main, finished, "--device", "cpu")
    assert code == 2
    assert "Cannot read the measurements" in printed
    code, printed = run(measure.main, finished, "--above", 1, "--below", 2)
    assert code == 2
    assert "Give one of the two" in printed
    scene, _, _ = open_scene(str(finished), device="cpu")
    session = ViewSession(LayerRenderer(scene), OneAtATime(), Wish(*[Layer("image", "thermal")] * 2))
    session.render(scene.start(), 32, 24)
    made = session.measure("spot", [(0.5, 0.5)])
    assert made is not None
    book = MeasurementBook(tmp_path / "other.json")
    book.add(replace(made, definition=replace(made.definition, spectrum="nir")))
    code, printed = run(measure.main, finished, tmp_path / "other.json", "--device", "cpu")
    assert code == 2
    assert "S1 measures image of nir, which the scene does not have" in printed
