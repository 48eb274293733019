"""geo.json: from the world of a capture to UTM, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from thermosplat.datasets import load_capture
from thermosplat.datasets.geo_file import GEO_FILE, GeoFrame, read_geo
from thermosplat.errors import UserError

SHED = GeoFrame(47.0512, 8.3064, 452.0, 0.8, 101)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [(47.0512, 8.3064, 32632), (-33.9, 18.4, 32734), (52.0, 11.99999, 32632), (0.01, -179.9, 32601)],
)
def test_the_world_lies_where_utm_has_it(latitude: float, longitude: float, epsg: int) -> None:
    """Half a kilometre from the origin, north and south, on the border of a zone: to 2 cm across, 5 cm in height."""
    geo = GeoFrame(latitude, longitude, 452.0, 0.5, 20)
    points = np.array([[0.0, 0.0, 0.0], [500.0, -300.0, 40.0], [-200.0, 400.0, -10.0]])
    transform = pycolmap.GPSTransform()
    utm, zone = transform.ellipsoid_to_utm(transform.enu_to_ellipsoid(points, latitude, longitude, 452.0))
    assert geo.epsg == epsg
    assert zone == epsg % 100
    np.testing.assert_allclose(geo.to_utm(points), utm, atol=0.05)
    np.testing.assert_allclose(geo.to_utm(points)[:, :2], utm[:, :2], atol=0.02)
    assert np.abs(geo.offset - geo.origin).max() <= 0.5


def test_the_file_is_read_back(tmp_path: Path) -> None:
    """What it says in matrices is what the frame does; a folder without the file has none."""
    assert read_geo(tmp_path) is None
    content = SHED.content()
    (tmp_path / GEO_FILE).write_text(json.dumps(content))
    assert read_geo(tmp_path) == SHED
    point = np.array([12.0, -7.0, 3.0, 1.0])
    np.testing.assert_allclose((np.array(content["utm_from_world"]) @ point)[:3], SHED.to_utm(point[:3]), atol=1e-6)
    np.testing.assert_allclose(np.array(content["world_from_utm"]) @ content["utm_from_world"], np.eye(4), atol=1e-6)


@pytest.mark.parametrize(
    "content",
    [
        "no json",
        "[" * 100_000,
        "[]",
        "{}",
        json.dumps({**SHED.content(), "latitude": 91}),
        json.dumps({**SHED.content(), "longitude": "east"}),
        json.dumps({**SHED.content(), "altitude": float("nan")}),
        json.dumps({**SHED.content(), "cameras": float("inf")}),
    ],
)
def test_a_damaged_file_is_explained(tmp_path: Path, content: str) -> None:
    """The sentence names the file and the command that makes it again."""
    (tmp_path / GEO_FILE).write_text(content)
    with pytest.raises(UserError, match=r"geo\.json is damaged") as error:
        read_geo(tmp_path)
    assert "thermosplat-prepare sfm" in (error.value.hint or "")


@pytest.mark.parametrize(("content", "geo"), [(SHED.content(), SHED), ({"type": "FeatureCollection"}, None)])
def test_captures_say_where_they_lie(tmp_path: Path, content: dict, geo: GeoFrame | None) -> None:
    """A file of that name that another program wrote is said and does no harm."""
    shutil.copytree(load_capture("sample").root, tmp_path / "capture")
    (tmp_path / "capture" / GEO_FILE).write_text(json.dumps(content))
    capture = load_capture(tmp_path / "capture")
    assert capture.geo == geo
    assert any("without a place on the Earth" in note for note in capture.notes) == (geo is None)
