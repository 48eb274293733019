"""Spots, lines and areas give the numbers of the pixels that they cover, and go into files whole."""

import csv
import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from thermosplat.datasets.placement import Placement
from thermosplat.thermal.radiometry import FLIR_IRON
from thermosplat.viewer.layers import Layer, LayerImage
from thermosplat.viewer.measure_panel import spot_cross
from thermosplat.viewer.measurements import covered_values, marked_picture, measure, save_measurements, value_at
from thermosplat.viewer.session import ViewSession, Wish
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


def test_an_area_covers_its_rectangle() -> None:
    """Both corners are in, whichever way it was drawn; minimum, maximum, mean and deviation are numpy's."""
    for corners in ([(0.2, 0.2), (0.45, 0.6)], [(0.45, 0.6), (0.2, 0.2)]):
        made = measure(layer(), "area", corners, "A1")
        assert made is not None
        part = FIELD[1:4, 2:5]
        assert (made.minimum, made.maximum, made.mean, made.count) == (part.min(), part.max(), part.mean(), 9)
        assert made.std == pytest.approx(part.std())
        assert made.text == "23.00 °C (12.00 to 34.00, std 8.21)"


def test_a_line_has_its_pixels_in_order() -> None:
    """From one end to the other, without gaps."""
    values = covered_values(FIELD, "line", [(0.05, 0.05), (0.95, 0.05)])
    np.testing.assert_array_equal(values, FIELD[0])
    steep = covered_values(FIELD, "line", [(0.05, 0.95), (0.25, 0.05)])
    assert len(steep) == 6
    assert (steep[0], steep[-1]) == (50.0, 2.0)


def test_pixels_without_a_value_do_not_count() -> None:
    """NaNs are left out, and where there is nothing else there is no measurement."""
    field = FIELD.copy()
    field[:, :5] = np.nan
    made = measure(layer(field), "area", [(0.0, 0.0), (0.99, 0.1)], "A1")
    assert made is not None
    assert (made.minimum, made.count) == (5.0, 5)
    assert measure(layer(field), "spot", [(0.1, 0.1)], "S1") is None
    assert measure(layer(None), "spot", [(0.1, 0.1)], "S1") is None


def test_files_hold_all_digits_and_the_marks(tmp_path: Path) -> None:
    """The CSV gives back each number; the PNG is larger than the picture by its legend and has the marks."""
    made = measure(layer(FIELD / np.float32(3)), "area", [(0.2, 0.2), (0.45, 0.6)], "A1")
    assert made is not None
    picture = np.zeros((60, 100, 3), np.uint8)
    marked = marked_picture(picture, [(made, [(0.2, 0.2), (0.5, 0.2), (0.5, 0.6), (0.2, 0.6)])], (FLIR_IRON, 0, 20, ""))
    table, image = save_measurements(tmp_path / "m", "one", [made], marked)
    (row,) = csv.DictReader(table.open(encoding="utf-8"))
    assert (float(row["mean"]), float(row["std"]), int(row["pixels"])) == (made.mean, made.std, 9)
    assert (row["unit"], row["layer"], row["quantity"]) == ("°C", "thermal", "temperature")
    written = cv2.imread(str(image))[..., ::-1]
    np.testing.assert_array_equal(written, marked)
    assert written.shape[1] > 100
    assert (written[12:36, 20:50] > 200).any()
    assert not picture.any()


def test_labels_do_not_lie_over_each_other() -> None:
    """Two spots side by side have their labels apart: as many pixels are darkened as by both alone."""
    made = measure(layer(), "spot", [(0.5, 0.5)], "S1")
    assert made is not None
    picture = np.full((400, 600, 3), 200, np.uint8)

    def covered(*places: tuple[float, float]) -> int:
        return int((marked_picture(picture, [(made, [place]) for place in places]) < 100).sum())

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
    (point,) = spot.points
    in_camera = shown.view.viewmat[:3, :3] @ point + shown.view.viewmat[:3, 3]
    assert unit * in_camera[2] == pytest.approx(spot.mean, rel=1e-5)


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
    session.measurements.pop(0)
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
    assert made.mean == expected
    assert session.measure("spot", [(0.3, 0.5)]) is None


def test_places_outside_are_at_the_edge(session: ViewSession) -> None:
    """A rectangle may be drawn over the edge of the picture, and a page may say any place."""
    made = session.measure("area", [(-1e9, 0.5), (1e9, 7.0)])
    assert made is not None
    assert made.points_px == ((0.0, 0.5), (1.0, 1.0))
    assert made.count == 48 * 18


def test_there_are_only_so_many(session: ViewSession, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that clicks without end does not fill the memory."""
    monkeypatch.setattr("thermosplat.viewer.session.MOST_MEASUREMENTS", 2)
    assert [session.measure("spot", [(0.5, 0.5)]) is None for _ in range(3)] == [False, False, True]


def test_a_mark_stays_on_its_object(session: ViewSession) -> None:
    """The point under a spot projects back onto it, and moves with the scene when the camera moves."""
    made = session.measure("spot", [(0.5, 0.5)])
    assert made is not None
    (point,) = made.points
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
