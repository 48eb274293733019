"""Maps of captures with GPS: positions of the cameras, UTM, and the similarity between."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.export.maps.georeference import aligned_frame, georeferenced_frame, gps_positions, utm_coordinates
from toy_scene import toy_capture

rasterio = pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')

LATITUDE, LONGITUDE = 47.5, 9.25


def flown(tmp_path: Path, *, on_a_line: bool = False, gps: bool = True) -> tuple[Capture, np.ndarray, np.ndarray]:
    """A capture of twelve cameras over a field, with a frames.csv; also their centres and their true UTM positions."""
    rng = np.random.default_rng(0)
    places = np.array([(LATITUDE + 1e-4 * (i // 4), LONGITUDE + 1e-4 * (i % 4), 500.0 + i % 3) for i in range(12)])
    if on_a_line:
        places = np.array([(LATITUDE + 1e-4 * i, LONGITUDE, 500.0) for i in range(12)])
    _, utm = utm_coordinates(places)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    centres = (utm - utm.mean(axis=0)) @ turn / 7.0  # the world is turned, and a unit is 7 m
    base = toy_capture()
    rows, frames = ["spectrum,file,source,width,height,time,latitude,longitude,altitude"], []
    for index, (centre, place) in enumerate(zip(centres, places)):
        viewmat = np.eye(4)
        viewmat[:3, 3] = -centre
        view = base.train[0].views["rgb"]
        path = tmp_path / "images" / "rgb" / "a" / f"{index}.jpg"
        frames.append(Frame(str(index), {"rgb": dataclasses.replace(view, viewmat=viewmat, path=path)}))
        rows.append(f"rgb,a/{index}.jpg,x.jpg,24,18,,{','.join(f'{x:.9f}' for x in place) if gps else ',,'}")
    (tmp_path / "frames.csv").write_text("\n".join(rows) + "\n")
    return dataclasses.replace(base, root=tmp_path, train=tuple(frames)), centres, utm


def test_cameras_lie_where_gps_has_them(tmp_path: Path) -> None:
    """Scale, turn and offset are found to centimetres; the zone is that of the longitude."""
    capture, centres, utm = flown(tmp_path)
    frame = georeferenced_frame(capture, "rgb")
    assert frame is not None
    assert frame.crs == "EPSG:32632"
    assert frame.scale == pytest.approx(7.0, rel=1e-4)
    np.testing.assert_allclose(frame.to_map(centres), utm, atol=0.02)
    np.testing.assert_allclose(frame.to_scene(utm), centres, atol=0.005)
    assert "12 cameras with GPS" in frame.note


def test_a_wrong_position_is_left_out(tmp_path: Path) -> None:
    """One camera whose GPS is off by 300 m does not move the map."""
    _, centres, utm = flown(tmp_path)
    wrong = utm.copy()
    wrong[4] += [300.0, -100.0, 50.0]
    frame = aligned_frame(centres, wrong, "EPSG:32632")
    np.testing.assert_allclose(np.delete(frame.to_map(centres), 4, axis=0), np.delete(utm, 4, axis=0), atol=0.02)


@pytest.mark.parametrize("how", [{"on_a_line": True}, {"gps": False}])
def test_too_little_gps_is_no_georeference(tmp_path: Path, how: dict[str, bool]) -> None:
    """From one line the turn about it is free; without positions there is nothing. The map stays local."""
    capture, _, _ = flown(tmp_path, **how)
    assert georeferenced_frame(capture, "rgb") is None


def test_captures_without_a_table_have_no_positions(tmp_path: Path) -> None:
    """frames.csv is optional."""
    capture = dataclasses.replace(toy_capture(), root=tmp_path)
    assert gps_positions(capture, "rgb") == {}
    assert georeferenced_frame(capture, "rgb") is None


def test_a_damaged_table_is_explained(tmp_path: Path) -> None:
    """A latitude that is no number names the file and the command that makes it."""
    capture, _, _ = flown(tmp_path)
    table = tmp_path / "frames.csv"
    table.write_text(table.read_text().replace("47.5", "north", 1))
    with pytest.raises(UserError, match=r"frames\.csv.*thermosplat-prepare import"):
        gps_positions(capture, "rgb")


def test_utm_agrees_with_known_coordinates() -> None:
    """The Eiffel tower is at 448,252 m east and 5,411,943 m north in zone 31 (published coordinates)."""
    crs, utm = utm_coordinates(np.array([[48.858222, 2.2945, 330.0]]))
    assert crs == "EPSG:32631"
    np.testing.assert_allclose(utm, [[448_252.0, 5_411_943.0, 330.0]], atol=15.0)
    assert utm_coordinates(np.array([[-33.9, 18.4, 0.0]]))[0] == "EPSG:32734"
