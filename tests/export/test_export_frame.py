"""Exported files in UTM: splats look the same before a camera that turns with them, and all files lie in one frame."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splat_scenes import scene_like_splats
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.export.export_frame import ExportFrame
from thermosplat.export.maps.georeference import located_frame
from thermosplat.export.splat_rendering import render_splats

FAR_EAST = GeoFrame(70.0, 11.9, 300.0, 0.4, 60)
"""Where north on the map is 2.7° from north."""


@pytest.mark.parametrize("degree", [0, 1, 4])
def test_splats_in_utm_look_the_same(degree: int) -> None:
    """Places, rotations, sizes and harmonics of all degrees turn with the map."""
    splats = scene_like_splats(60, degree)
    frame = ExportFrame(WORLD, FAR_EAST)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 12.0
    K = torch.tensor([[60.0, 0.0, 24.0], [0.0, 60.0, 18.0], [0.0, 0.0, 1.0]])
    to_file = np.eye(4)
    to_file[:3, :3] = FAR_EAST.scale * FAR_EAST.rotation
    to_file[:3, 3] = FAR_EAST.offset - FAR_EAST.origin
    turned = np.linalg.inv(to_file @ np.linalg.inv(viewmat.double().numpy()))
    turned[:3] *= FAR_EAST.scale  # a camera has no scale
    before = render_splats(splats, ViewTensors(viewmat, K, 48, 36))
    after = render_splats(frame.splats(splats), ViewTensors(torch.as_tensor(turned).float(), K, 48, 36))
    assert before.std() > 0.03
    torch.testing.assert_close(after, before, rtol=1e-3, atol=2e-4)


@pytest.mark.parametrize("placement", [WORLD, Placement((0.0, 0.0, 0.0), 4.0)])
def test_splats_points_and_maps_lie_in_one_frame(tmp_path: Path, placement: Placement) -> None:
    """A Gaussian, a point and a place on the map are at one place in UTM, to millimetres."""
    frame = ExportFrame(placement, FAR_EAST)
    splats = scene_like_splats(20, 0)
    scene = splats.means.double().numpy()
    (line,) = frame.write(tmp_path)
    told = json.loads((tmp_path / "geo.json").read_text())
    assert told["epsg"] == FAR_EAST.epsg == 32632
    assert "UTM zone 32N" in line
    utm = FAR_EAST.to_utm(placement.to_world(scene))
    np.testing.assert_allclose(frame.splats(splats).means.numpy() + told["origin"], utm, atol=2e-3)
    np.testing.assert_allclose(frame.points(placement.to_world(scene)) + told["origin"], utm, atol=2e-3)
    map_frame = located_frame(FAR_EAST, placement)
    assert map_frame.crs == "EPSG:32632"
    np.testing.assert_allclose(map_frame.to_map(scene), utm, atol=1e-6)


def test_a_capture_without_a_place_is_as_before(tmp_path: Path) -> None:
    """Nothing is turned or written."""
    frame = ExportFrame(WORLD)
    splats = scene_like_splats(20, 1)
    assert frame.splats(splats) is splats
    assert frame.write(tmp_path) == frame.comments() == list(tmp_path.iterdir()) == []
