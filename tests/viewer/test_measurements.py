"""Spots, lines and areas give the numbers of the pixels that they cover, and go into files whole."""

import csv
import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.thermal.radiometry import FLIR_IRON
from thermosplat.thermal.recalculation import Recalculation
from thermosplat.thermography.measurements import Alarm
from thermosplat.thermography.measurements_file import read_book
from thermosplat.thermography.scene_temperatures import SceneTemperatures
from thermosplat.thermography.shapes import SHAPES, Shape
from thermosplat.viewer.layers import Layer, LayerImage
from thermosplat.viewer.measure_panel import spot_cross
from thermosplat.viewer.measurements import Mark, marked_picture, save_measurements, value_at
from thermosplat.viewer.measuring import Measurer
from thermosplat.viewer.session import ViewSession
from thermosplat.viewer.wish import Wish
from viewed_toy import moved, toy_session, viewed_toy

FIELD = np.arange(60, dtype=np.float32).reshape(6, 10)
THERMAL = Layer("image", "thermal")


def layer(field: np.ndarray | None = FIELD) -> LayerImage:
    colors = np.zeros((6, 10, 3), np.float32) if field is None else None
    return LayerImage(THERMAL, field, colors, FLIR_IRON, (0.0, 60.0), "°C", "temperature")


def test_the_value_under_a_point() -> None:
    """Pixels are half-open squares, and the last one has the border; outside there is nothing."""
    assert value_at(layer(), 0.0, 0.0) == 0.0
    assert value_at(layer(), 0.1, 0.0) == 1.0
    assert value_at(layer(), 1.0, 1.0) == 59.0
    assert value_at(layer(), 1.01, 0.5) is None
    assert value_at(layer(None), 0.5, 0.5) is None
    assert value_at(layer(np.full((6, 10), np.nan, np.float32)), 0.5, 0.5) is None


def test_labels_do_not_lie_over_each_other() -> None:
    """Two spots side by side have their labels apart: as many pixels are darkened as by both alone."""
    picture = np.full((400, 600, 3), 200, np.uint8)

    def covered(*places: tuple[float, float]) -> int:
        return int((marked_picture(picture, [Mark("S1 23.41 °C", "spot", (place,)) for place in places]) < 100).sum())

    left, right = (0.5, 0.5), (0.54, 0.5)
    assert covered(left) > 500
    assert covered(left, right) == pytest.approx(covered(left) + covered(right), rel=0.05)


def test_the_cross_of_a_spot_is_upright_where_it_was_measured() -> None:
    """Its arms are level and plumb in that picture, 3% of the height long, whatever the distance."""
    start = viewed_toy().start()
    pose = np.linalg.inv(start.viewmat)
    for depth in (1.0, 7.0):
        point = pose[:3, :3] @ np.array([0.1, -0.2, depth]) + pose[:3, 3]
        seen = spot_cross(point, start) @ start.viewmat[:3, :3].T + start.viewmat[:3, 3]
        flat = seen[..., :2] / seen[..., 2:] / (2 * np.tan(np.radians(start.fov_y) / 2))  # in picture heights
        np.testing.assert_allclose(flat[:, 1] - flat[:, 0], 0.03 * np.eye(2), atol=1e-6)


@pytest.mark.parametrize("unit", [1.0, 0.125])
def test_depths_are_the_worlds_and_marks_lie_on_the_scene(unit: float) -> None:
    """Whatever units the scene is trained in: the depth layer has world units, marks are where they were put."""
    made = toy_session(viewed_toy())
    made.renderer.scene.model.placement = Placement(unit=unit)
    depth = Layer("depth", "rgb")
    made.wish = Wish(depth, THERMAL)
    shown = made.render(made.renderer.scene.start(), 48, 36)
    field = shown.layers[depth].field
    assert field is not None
    assert 3.0 * unit < np.nanmedian(field) < 5.0 * unit
    spot = made.measure("spot", [(0.5, 0.5)])
    assert spot is not None
    (point,) = spot.numbers.points
    in_camera = shown.view.viewmat[:3, :3] @ (np.array(point) / unit) + shown.view.viewmat[:3, 3]
    assert unit * in_camera[2] == pytest.approx(spot.numbers.mean, rel=1e-5)


@pytest.fixture
def session() -> ViewSession:
    made = toy_session(viewed_toy())
    made.wish = Wish(THERMAL, Layer("image", "rgb"))
    made.render(made.renderer.scene.start(), 48, 36)
    return made


def test_a_session_reads_and_numbers(session: ViewSession) -> None:
    """The cursor reads the field; spots are S1, S2; a deleted number is used again only at the end."""
    assert session.shown is not None
    field = session.shown.layers[THERMAL].field
    assert field is not None
    value, text = session.probe(0.5, 0.5)  # type: ignore[misc]
    assert value == field[18, 24]
    assert text == f"{value:.2f} °C"
    names = [session.measure("spot", [(0.4, 0.5)]), session.measure("spot", [(0.5, 0.5)])]
    assert [made.name for made in names if made] == ["S1", "S2"]
    session.book.delete("S1")
    again = session.measure("spot", [(0.5, 0.4)])
    assert again is not None
    assert again.name == "S3"


def test_two_quick_clicks_have_two_names(session: ViewSession, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where both are on their way before the depth of either is rendered."""
    render, both = session.renderer.render, threading.Barrier(2, timeout=60)
    monkeypatch.setattr(session, "turns", SimpleNamespace(run=lambda work: work()))
    monkeypatch.setattr(session.renderer, "render", lambda *a, **k: (both.wait(), render(*a, **k))[1])
    clicks = [threading.Thread(target=session.measure, args=("spot", [(x, 0.5)])) for x in (0.4, 0.6)]
    for click in clicks:
        click.start()
    for click in clicks:
        click.join()
    assert sorted(made.name for made in session.measurements) == ["S1", "S2"]


def test_a_click_measures_the_picture_that_was_clicked(session: ViewSession) -> None:
    """Not the one that has come meanwhile, small and from elsewhere."""
    clicked = session.shown
    assert clicked is not None
    expected = value_at(clicked.layers[THERMAL], 0.3, 0.5)
    session.render(moved(session.renderer.scene.start(), 0.3), 24, 18, full=False)
    made = session.measure("spot", [(0.3, 0.5)], clicked)
    assert made is not None
    assert made.numbers.mean == expected
    assert session.measure("spot", [(0.3, 0.5)]) is None


def test_places_outside_are_at_the_edge(session: ViewSession) -> None:
    """A rectangle may be drawn over the edge of the picture, and a page may say any place."""
    made = session.measure("rectangle", [(-1e9, 0.5), (1e9, 7.0)])
    assert made is not None
    assert made.definition.places == ((0.0, 18.0), (48.0, 36.0))
    assert made.numbers.count == 48 * 18


def test_there_are_only_so_many(session: ViewSession, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that clicks without end does not fill the memory."""
    monkeypatch.setattr("thermosplat.thermography.measurement_book.MOST_MEASUREMENTS", 2)
    for _ in range(2):
        assert session.measure("spot", [(0.5, 0.5)]) is not None
    with pytest.raises(UserError, match="2 measurements already"):
        session.measure("spot", [(0.5, 0.5)])


def test_a_mark_stays_on_its_object(session: ViewSession) -> None:
    """The point under a spot projects back onto it, and moves with the scene when the camera moves."""
    made = session.measure("spot", [(0.5, 0.5)])
    assert made is not None
    (point,) = made.numbers.points
    start = session.renderer.scene.start()
    seen = start.viewmat @ np.array([*point, 1.0])
    assert seen[:2] == pytest.approx([0, 0], abs=1e-5)
    assert seen[2] > 0
    shown = session.render(moved(start, 0.1), 48, 36)
    picture = session.marked(shown)
    assert picture.shape[1] > 48


def test_a_wipe_reads_what_it_shows(session: ViewSession) -> None:
    """Left of the edge the first layer, right of it the second, which has colours and no value."""
    session.wish = dataclasses.replace(session.wish, comparison="wipe", share=0.5)
    session.render(session.renderer.scene.start(), 48, 36)
    assert session.probe(0.4, 0.5) is not None
    assert session.probe(0.6, 0.5) is None
    assert session.measure("spot", [(0.6, 0.5)]) is None


def test_files_hold_everything(session: ViewSession, tmp_path: Path) -> None:
    """Table and JSON have all digits, the place in the scene and in px, and the view; the PNG has marks and legend."""
    made = session.measure("rectangle", [(0.3, 0.3), (0.6, 0.7)])
    assert made is not None
    assert session.shown is not None
    marked = session.marked(session.shown)
    table, image = save_measurements(tmp_path / "m", "one", session.book.pages, marked)
    (row,) = csv.DictReader(table.open(encoding="utf-8"))
    assert (float(row["mean"]), float(row["std"]), int(row["pixels"])) == (
        *(made.numbers.mean, made.numbers.std),
        made.numbers.count,
    )
    assert (row["unit"], row["layer"], row["quantity"]) == ("°C", "image", "temperature")
    assert len(row["points"].split(";")) == 4
    assert len(row["viewmat"].split()) == 16
    assert row["places_px"] == "14.399999999999999 10.799999999999999; 28.799999999999997 25.2"
    assert row["max_point"]
    np.testing.assert_array_equal(cv2.imread(str(image))[..., ::-1], marked)
    assert marked.shape[1] > 48
    (read,) = read_book(table.with_suffix(".json"))[0].measurements
    assert read.numbers == made.numbers


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_anchored_on_the_scene(session: ViewSession, shape: Shape) -> None:
    """Its outline and extremes are points of the scene; lines have a length, areas a surface; renders find them."""
    places = {"spot": [(0.5, 0.5)], "polygon": [(0.3, 0.3), (0.7, 0.3), (0.5, 0.7)]}.get(
        shape, [(0.3, 0.4), (0.6, 0.6)]
    )
    made = session.measure(shape, places)
    assert made is not None
    found = made.numbers
    assert all(point is not None for point in (*found.points, found.minimum_point, found.maximum_point))
    assert (found.length is not None) == (shape == "line")
    assert (found.area is not None) == (shape not in ("spot", "line"))
    assert found.minimum <= found.mean <= found.maximum
    assert Measurer(session.renderer).measure(made.definition) == found


def test_alarms_and_settings_of_one_measurement(session: ViewSession) -> None:
    """The alarm tells which share it holds for; own settings recalculate this one alone."""
    session.temperatures = SceneTemperatures(
        session.renderer.scene.model, session.renderer.scene.scales, Recalculation.of(None, TemperatureSettings())
    )
    one, other = (session.measure("rectangle", [(0.3, 0.3), (0.6, 0.7)]) for _ in range(2))
    assert one is not None
    assert other is not None
    session.measure_again("R1", alarm=Alarm("above", one.numbers.mean))
    alarmed = session.book.pages.by_name["R1"]
    assert 0 < alarmed.numbers.alarm_share < 1
    session.measure_again("R1", settings={"emissivity": 0.7, "reflected": 5.0})
    own, kept = (session.book.pages.by_name[name].numbers for name in ("R1", "R2"))
    assert own.mean != pytest.approx(one.numbers.mean, abs=0.1)
    assert (own.recalculated_share, own.recalculated) == (1.0, "recalculated: emissivity 0.7, reflected 5 °C")
    assert kept == other.numbers
    session.recalculate(TemperatureSettings(emissivity=0.8))
    session.renumber()
    assert session.book.pages.by_name["R2"].numbers.mean != kept.mean
    assert session.book.pages.settings == {"emissivity": 0.8}
