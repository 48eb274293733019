"""Maps of a made scene whose temperatures are known, local and georeferenced."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from field_scene import LOW, celsius_at, field_model
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.export.maps.map_frame import MapFrame, local_frame, map_extent
from thermosplat.export.maps.orthomosaic import MapGrid, render_map, write_map
from toy_scene import toy_capture


def tilted() -> np.ndarray:
    """Axes of the map in a world that lies askew."""
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return axes * np.sign(np.linalg.det(axes))


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_temperatures_of_a_map_are_the_truth(scale: float) -> None:
    """Each pixel of the ground has its own temperature, whatever the world's axes and unit; beside it there is NaN."""
    rotation = tilted()
    model, capture = field_model(rotation)
    frame = MapFrame(rotation, scale, np.array([500_000.0, 5_000_000.0, 100.0]))
    extent = (499_993.75, 4_999_993.75, 500_006.25, 5_000_006.25)
    pixel = 0.04 * scale
    grid = MapGrid.covering(frame, extent, pixel, top=100.0 + 3.0 * scale)
    celsius = render_map(model, "thermal", capture.scales["thermal"], grid, sh_degree=0)[0]
    east = (grid.west + (np.arange(grid.width) + 0.5) * pixel - 500_000.0) / scale
    north = (grid.north - (np.arange(grid.height) + 0.5) * pixel - 5_000_000.0) / scale
    truth = celsius_at(*np.meshgrid(east, north))
    inside = (np.abs(east) < 1.9)[None] & (np.abs(north) < 1.4)[:, None]
    assert np.isfinite(celsius[inside]).all()
    assert np.isnan(celsius[(np.abs(north) > 1.7)]).all()
    error = np.abs(celsius - truth)[inside]
    assert np.median(error) < 0.1
    edges = np.abs(np.diff(truth, axis=1, append=truth[:, -1:])) + np.abs(np.diff(truth, axis=0, append=truth[-1:]))
    far = ~_widened(edges > 1.0, 4)
    assert np.abs(celsius - truth)[inside & far].max() < 0.3
    assert error.max() > 1.0  # the square's edges are blurred: the map is no copy of the truth


def _widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    for axis in (0, 1):
        mask = np.logical_or.reduce([np.roll(mask, shift, axis) for shift in range(-pixels, pixels + 1)])
    return mask


def test_tiles_meet_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map that is rendered in parts is the map that is rendered at once."""
    model, capture = field_model(np.eye(3))
    grid = MapGrid.covering(MapFrame(np.eye(3)), (-2.0, -1.5, 2.0, 1.5), 0.05, top=3.0)
    whole = render_map(model, "rgb", capture.scales["rgb"], grid, sh_degree=0)
    monkeypatch.setattr("thermosplat.export.maps.orthomosaic.TILE", 33)
    parts = render_map(model, "rgb", capture.scales["rgb"], grid, sh_degree=0)
    assert whole.shape == (3, 60, 80)
    np.testing.assert_allclose(parts, whole, atol=2e-6)


def test_what_lies_above_the_top_is_left_out() -> None:
    """From above the roof its cold is seen, from below it the ground."""
    model, capture = field_model(np.eye(3))
    means = []
    for top in (3.0, 8.0):
        grid = MapGrid.covering(MapFrame(np.eye(3)), (-1.0, -1.0, 1.0, 1.0), 0.1, top=top)
        means.append(render_map(model, "thermal", capture.scales["thermal"], grid, sh_degree=0).mean())
    assert means[0] > 13.0
    assert means[1] == pytest.approx(LOW, abs=0.2)


def test_files_have_coordinates_units_and_gaps(tmp_path: Path) -> None:
    """rasterio reads back the place of each pixel, what the band is, and which pixels hold nothing."""
    rasterio = pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')
    scale = toy_capture(thermal_kind="scalar").scales["thermal"]
    frame = MapFrame(np.eye(3), 1.0, np.zeros(3), "EPSG:32632", "a note")
    grid = MapGrid.covering(frame, (500_000.0, 5_000_000.0, 500_002.0, 5_000_001.0), 0.5, top=9.0)
    picture = np.array([[[20.0, 21.0, np.nan, 23.0], [10.0, 11.0, 12.0, 13.0]]], np.float32)
    write_map(tmp_path / "map.tif", picture, "thermal", scale, grid)
    with rasterio.open(tmp_path / "map.tif") as file:
        np.testing.assert_array_equal(file.read(), picture)
        assert np.isnan(file.nodata)
        assert file.crs.to_epsg() == 32632
        assert file.xy(0, 0) == (500_000.25, 5_000_000.75)
        assert (file.descriptions, file.units) == (("thermal celsius",), ("celsius",))
        assert file.tags()["FRAME"] == "a note"
    assert [path.name for path in tmp_path.iterdir()] == ["map.tif"]


def looking(direction: np.ndarray, count: int = 6) -> Capture:
    """The toy capture before cameras in a row that look one way."""
    capture = toy_capture()
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.3, 1.0, 0.2], z)
    x /= np.linalg.norm(x)
    frames = []
    for index in range(count):
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
        viewmat[:3, 3] = -viewmat[:3, :3] @ np.array([index, 0.0, 5.0])
        views = {n: dataclasses.replace(v, viewmat=viewmat) for n, v in capture.train[0].views.items()}
        frames.append(Frame(f"f{index}", views))
    return dataclasses.replace(capture, train=tuple(frames))


def test_a_local_map_has_the_worlds_coordinates() -> None:
    """Of a scene that is trained far from them and in other units; the picture is the same."""
    model, capture = field_model(np.eye(3))
    placed = dataclasses.replace(capture, placement=Placement((5e5, 4.6e6, 300.0), 4.0))
    near, far = (local_frame(one, "rgb", (0, 0, 1)) for one in (capture, placed))
    np.testing.assert_allclose(far.to_map(capture.points), placed.placement.to_world(capture.points), atol=1e-9)
    extents = np.array([map_extent(near, capture), map_extent(far, placed)])
    np.testing.assert_allclose(extents[1], 4 * extents[0] + [5e5, 4.6e6, 5e5, 4.6e6], rtol=1e-12)
    maps = [
        render_map(model, "rgb", capture.scales["rgb"], MapGrid.covering(frame, extent, pixel, top), sh_degree=0)
        for frame, extent, pixel, top in ((near, extents[0], 0.1, 3.0), (far, extents[1], 0.4, 312.0))
    ]
    np.testing.assert_allclose(maps[1], maps[0], atol=1e-4)


def test_cameras_of_a_flight_look_down() -> None:
    """Where all look one way, that way is down; a given direction goes before."""
    down = np.array([0.1, 0.2, -1.0])
    frame = local_frame(looking(down), "rgb")
    np.testing.assert_allclose(frame.rotation[2], -down / np.linalg.norm(down), atol=1e-9)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(local_frame(looking(down), "rgb", (0, 2, 0)).rotation[2], [0, 1, 0], atol=1e-12)
    west, south, east, north = map_extent(frame, looking(down))
    assert west < east
    assert south < north


def test_cameras_around_a_scene_are_held_upright() -> None:
    """Where they look all ways, up is the mean of their images' up."""
    capture = looking(np.array([1.0, 0.0, 0.0]))
    other = looking(np.array([-1.0, 0.0, 0.0]))
    both = dataclasses.replace(capture, train=(*capture.train, *other.train))
    ups = -np.stack([frame.views["rgb"].viewmat[1, :3] for frame in both.train]).mean(axis=0)
    np.testing.assert_allclose(local_frame(both, "rgb").rotation[2], ups / np.linalg.norm(ups), atol=1e-9)


@pytest.mark.parametrize(
    ("extent", "pixel", "message"),
    [
        ((0, 0, 1, 1), 0.0, "--gsd must be greater than 0"),
        ((1, 0, 0, 1), 0.1, "--extent must be WEST SOUTH EAST NORTH"),
        ((0, 0, 1000, 1000), 0.01, "is too large"),
        ((0, 0, 1000, 1000), 1e-320, "is too large"),
    ],
)
def test_impossible_grids_are_explained(extent: tuple[float, ...], pixel: float, message: str) -> None:
    """The sentence names the flag."""
    with pytest.raises(UserError, match=message):
        MapGrid.covering(MapFrame(np.eye(3)), extent, pixel, top=1.0)  # type: ignore[arg-type]


def test_cold_ground_is_on_the_map() -> None:
    """What is transparent in the thermal spectrum alone has the lowest temperature there, and is no hole."""
    model, capture = field_model(np.eye(3))
    clear = model.gaussians("thermal")
    clear.logit_opacities = torch.nn.Parameter(torch.full_like(clear.logit_opacities, -20.0))
    grid = MapGrid.covering(MapFrame(np.eye(3)), (-1.0, -1.0, 1.0, 1.0), 0.1, top=3.0)
    celsius = render_map(model, "thermal", capture.scales["thermal"], grid, sh_degree=0)
    np.testing.assert_allclose(celsius, LOW, atol=0.01)
