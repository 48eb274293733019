"""A field at two dates, rendered from above, compared, and written as files."""

import csv
import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from field_scene import HIGH, LOW, celsius_at, field_model
from thermosplat.comparison.compare import compare
from thermosplat.comparison.dated_map import Date
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.scene.gaussians import SH_C0
from thermosplat.scene.model import SceneModel
from thermosplat.thermography.certainty import Sure
from thermosplat.thermography.comparison_file import read_comparison

rasterio = pytest.importorskip("rasterio")
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def date(name: str, path: Path, model: SceneModel, capture: Any, to_first: MapFrame) -> Date:
    """A date whose intervals are 0.4 °C either way."""
    sure = SimpleNamespace(
        of_view=lambda view, shown: Sure(np.full(shown.shape, 0.4), np.zeros(shown.shape, np.uint8)),
        calibration=SimpleNamespace(level=0.1),
    )
    run: Any = SimpleNamespace(
        model=model,
        scales=capture.scales,
        sh_degree=0,
        device=torch.device("cpu"),
        geo=None,
        directory=SimpleNamespace(path=path / name),
        certainties=lambda capture: {"thermal": sure},
        temperatures=lambda: None,
    )
    return Date(name, run, capture, to_first)


def warmer_but_for_a_place(model: SceneModel) -> SceneModel:
    """2 °C warmer everywhere, and the warm square as it was."""
    for name in model.spectra:
        gaussians = model.gaussians(name)
        east, north = gaussians.means[:, 0].numpy(), gaussians.means[:, 1].numpy()
        square = (east > 0.2) & (east < 1.0) & (north > 0.3) & (north < 1.1)
        change = torch.tensor(np.where(square, 0.0, 2.0) / (HIGH - LOW) / SH_C0, dtype=torch.float32)
        gaussians.sh0.data += change[:, None, None]
    return model


@torch.no_grad()
def test_a_place_of_known_area_in_another_scenes_frame(tmp_path: Path) -> None:
    """The shift and the place are found though the second scene is turned; tables, maps, points and the page say so."""
    model, capture = field_model(np.eye(3))
    other, _ = field_model(np.eye(3))
    other = warmer_but_for_a_place(other)
    for name in other.spectra:  # the other scene has axes of its own
        other.gaussians(name).means.data = other.gaussians(name).means @ torch.tensor(TURN, dtype=torch.float32)
    flat = dataclasses.replace(capture, points=np.array([[-2, -1.5, 0], [2, 1.5, 0]], np.float32))
    dates = [
        date("march", tmp_path, model, flat, MapFrame(np.eye(3))),
        date("june", tmp_path, other, flat, MapFrame(TURN)),
    ]
    said = compare(dates, "thermal", "rgb", tmp_path / "made", pixel=0.04, extent=(-1.8, -1.3, 1.8, 1.3))
    assert "1 colder" in said[0]
    content = json.loads((tmp_path / "made" / "changes.json").read_text())
    (found,) = content["dates"]
    assert found["shift"] == pytest.approx(2.0, abs=0.1)
    assert found["shift_plus_minus"] == pytest.approx(1.96 * 0.1 * 2**0.5, rel=0.01)
    known = read_comparison(tmp_path / "made").of(tmp_path / "june")
    assert np.allclose(known.to_first, np.column_stack([TURN, np.zeros(3)]))
    (change,) = found["changes"]
    assert (change["east"], -change["north"]) == pytest.approx((0.6, 0.7), abs=0.05)  # its cameras stand on their heads
    assert change["area"] == pytest.approx(0.64, rel=0.25)
    assert change["difference"] == pytest.approx(-2.0, abs=0.3)
    rows = list(csv.reader((tmp_path / "made" / "over_time.csv").open()))
    assert rows[0] == ["what", "march", "june"]
    assert float(rows[1][1]) == pytest.approx(float(celsius_at(np.array(0.6), np.array(0.7))), abs=0.5)
    assert float(rows[1][2]) == pytest.approx(float(rows[1][1]), abs=0.3)
    with rasterio.open(tmp_path / "made" / "difference_june.tif") as file:
        assert file.units == ("celsius", "celsius")
        assert np.nanmin(file.read(1)) == pytest.approx(-2.0, abs=0.3)
    page = (tmp_path / "made" / "index.html").read_text()
    assert all((tmp_path / "made" / name).is_file() for name in _pictures(page))
    mesh = tmp_path / "made" / "difference_june.ply"
    header, body = mesh.read_bytes().split(b"end_header\n", 1)
    points, faces = (int(header.split(b"element " + what)[1].split()[0]) for what in (b"vertex", b"face"))
    assert len(body) == 23 * points + 13 * faces
    assert 1.8 * points < faces < 2 * points
    table = np.frombuffer(body, np.dtype([("place", "<f4", 3), ("rest", "u1", 11)]), points)
    assert np.isfinite(table["place"]).all()


STANDPOINT = {"viewmat": np.diag([1.0, -1.0, -1.0, 1.0]).tolist(), "fov_y": 40.0, "width": 80, "height": 60}
STANDPOINT["viewmat"][2][3] = 4.0  # below the roof
SPOT = {"name": "S1", "shape": "spot", "layer": "image", "spectrum": "thermal", "places_px": [[52.5, 16.5]]}
BOOK = {"format": "thermosplat-measurements", "version": 1, "measurements": [{**SPOT, "view": STANDPOINT}]}


@torch.no_grad()
def test_a_measurement_and_a_place_over_three_dates(tmp_path: Path) -> None:
    """A place that differs at two later dates has one row, and a spot of the first run is measured in each scene's own
    axes and units."""
    model, capture = field_model(np.eye(3))
    flat = dataclasses.replace(capture, points=np.array([[-2, -1.5, 0], [2, 1.5, 0]], np.float32))
    there = MapFrame(TURN, 2.0, np.array([1.0, 0.5, 3.0]))
    other = warmer_but_for_a_place(field_model(np.eye(3))[0])
    for name in other.spectra:
        gaussians = other.gaussians(name)
        gaussians.means.data = torch.tensor(there.to_scene(gaussians.means.numpy()), dtype=torch.float32)
        gaussians.log_scales.data -= np.log(there.scale)
    dates = [date("march", tmp_path, model, flat, MapFrame(np.eye(3)))]
    dates += [date(name, tmp_path, other, flat, there) for name in ("june", "july")]
    for day, one in enumerate(dates, 1):
        root = tmp_path / one.name
        root.mkdir()
        (root / "frames.csv").write_text(f"spectrum,file,time\nthermal,a.png,2026-06-0{day}T10:00:00\n")
    dates = [dataclasses.replace(one, capture=dataclasses.replace(flat, root=tmp_path / one.name)) for one in dates]
    (tmp_path / "march" / "measurements").mkdir()
    (tmp_path / "march" / "measurements" / "measurements.json").write_text(json.dumps(BOOK))
    compare(dates, "thermal", "rgb", tmp_path / "made", pixel=0.04, extent=(-1.8, -1.3, 1.8, 1.3))
    head, place, spot = csv.reader((tmp_path / "made" / "over_time.csv").open())
    assert head == ["what", "march", "june", "july"]
    assert place[0] == "june 1, colder"
    for row in (place, spot):  # the warm square, which is as it was
        values = [float(value) for value in row[1:]]
        assert values == pytest.approx([float(celsius_at(np.array(0.6), np.array(0.7)))] * 3, abs=0.5)
    page = (tmp_path / "made" / "index.html").read_text()
    assert (page.count("<svg"), page.count("days since 2026-06-01 10:00")) == (2, 2)
    assert "june 1, colder [°C]" in page
    times = json.loads((tmp_path / "made" / "changes.json").read_text())["times"]
    assert times == [f"2026-06-0{day}T10:00:00" for day in (1, 2, 3)]


def _pictures(page: str) -> list[str]:
    return [part.split('"')[0] for part in page.split('src="')[1:]]
