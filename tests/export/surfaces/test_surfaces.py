"""Points and meshes of a field whose place and temperatures are known."""

from pathlib import Path

import numpy as np
import pytest
import torch

from field_scene import celsius_at, field_model
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.datasets.placement import Placement
from thermosplat.datasets.transforms.point_cloud import read_point_cloud
from thermosplat.errors import UserError
from thermosplat.export.formats.ply_tables import write_points
from thermosplat.export.surfaces.depth_views import depth_points, depth_view
from thermosplat.export.surfaces.tsdf_mesh import tsdf_mesh

VALUES = "scalar_thermal_celsius"


def views() -> list[ViewTensors]:
    """Cameras between ground and roof that look down, one of them aslant."""
    K = torch.tensor([[70.0, 0.0, 40.0], [0.0, 70.0, 30.0], [0.0, 0.0, 1.0]])
    found = []
    for east, north, tilt in ((-0.5, 0.0, 0.0), (0.5, 0.2, 0.0), (0.0, -0.3, 0.3)):
        lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        rotation = lean @ np.diag([1.0, -1.0, -1.0])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ np.array([east, north, 3.0])
        found.append(ViewTensors(torch.tensor(viewmat, dtype=torch.float32), K, 80, 60))
    return found


def test_points_lie_on_the_ground_and_have_its_temperature() -> None:
    """All views agree about the plane; colours and °C are those of the place."""
    model, capture = field_model(np.eye(3))
    cloud = depth_points(model, "thermal", views(), capture.scales, sh_degree=0, most=3000)
    assert 1500 < len(cloud.points) <= 3000
    assert np.abs(cloud.points[:, 2]).max() < 0.06
    truth = celsius_at(cloud.points[:, 0], cloud.points[:, 1])
    assert np.median(np.abs(cloud.values[VALUES] - truth)) < 0.2
    assert cloud.colors.std() > 5


def test_nothing_is_seen_at_edges_and_beside_the_scene() -> None:
    """Where the ground ends there is no depth, nor beside it."""
    model, capture = field_model(np.eye(3))
    up = views()[0]
    away = ViewTensors(up.viewmat.clone(), up.K, up.width, up.height)
    away.viewmat[:3, 3] += torch.tensor([-50.0, 0.0, 0.0])
    assert (depth_view(model, "rgb", away, capture.scales, sh_degree=0).depth == 0).all()
    seen = depth_view(model, "rgb", up, capture.scales, sh_degree=0)
    assert (seen.depth > 0).float().mean() > 0.5
    assert seen.values.keys() == {VALUES}


def test_a_mesh_is_the_ground() -> None:
    """Vertices lie on the plane to a fraction of a voxel, triangles face the cameras, values are the truth's."""
    pytest.importorskip("skimage", reason='scikit-image is not installed (pip install ".[mesh]")')
    model, capture = field_model(np.eye(3))
    bounds = (np.array([-1.0, -0.8, -0.5]), np.array([1.0, 0.8, 0.5]))
    mesh = tsdf_mesh(model, "thermal", views(), capture.scales, bounds, voxel=0.05, sh_degree=0)
    vertices = mesh.vertices.points
    assert len(mesh.faces) > 1000
    assert np.abs(vertices[:, 2]).max() < 0.05
    corners = vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).mean() > 0.99
    truth = celsius_at(vertices[:, 0], vertices[:, 1])
    assert np.nanmedian(np.abs(mesh.vertices.values[VALUES] - truth)) < 0.3
    for too_small in (1e-4, 1e-320):
        with pytest.raises(UserError, match="voxels are too many"):
            tsdf_mesh(model, "thermal", views(), capture.scales, bounds, voxel=too_small, sh_degree=0)
    nothing = (np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.5, 1.5]))
    with pytest.raises(UserError, match="No surface of thermal was found"):
        tsdf_mesh(model, "thermal", views(), capture.scales, nothing, voxel=0.1, sh_degree=0)


def test_surfaces_lie_in_the_world(tmp_path: Path) -> None:
    """In double precision where the world's origin is far, so that files hold the capture's own coordinates."""
    pytest.importorskip("skimage", reason='scikit-image is not installed (pip install ".[mesh]")')
    model, capture = field_model(np.eye(3))
    how, bounds = {"sh_degree": 0}, (np.array([-1.0, -0.8, -0.5]), np.array([1.0, 0.8, 0.5]))
    cloud = depth_points(model, "thermal", views(), capture.scales, most=300, **how)
    mesh = tsdf_mesh(model, "thermal", views(), capture.scales, bounds, voxel=0.125, **how)
    model.placement = Placement((5e5, 4.6e6, 300.0), 4.0)
    far = depth_points(model, "thermal", views(), capture.scales, most=300, **how)
    np.testing.assert_allclose(far.points, model.placement.to_world(cloud.points), atol=1e-9)
    in_world = tuple(map(model.placement.to_world, bounds))
    other = tsdf_mesh(model, "thermal", views(), capture.scales, in_world, voxel=0.5, **how)
    np.testing.assert_allclose(other.vertices.points, model.placement.to_world(mesh.vertices.points), atol=1e-5)
    for name, one in (("near", cloud), ("far", far)):
        write_points(tmp_path / f"{name}.ply", one.points, one.colors, one.values)
    assert b"property float x" in (tmp_path / "near.ply").read_bytes()[:200]
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "far.ply")[0], far.points)


def test_files_are_read_by_others(tmp_path: Path) -> None:
    """plyfile finds positions, colours, scalars and triangles."""
    plyfile = pytest.importorskip("plyfile", reason='plyfile is not installed (pip install ".[test]")')
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    celsius = np.array([20, 21, np.nan, 23], np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    write_points(tmp_path / "mesh.ply", points, colors, {VALUES: celsius}, ["a comment"], faces=faces)
    ply = plyfile.PlyData.read(str(tmp_path / "mesh.ply"))
    assert ply.comments == ["a comment"]
    vertex = ply["vertex"]
    assert [prop.name for prop in vertex.properties] == ["x", "y", "z", "red", "green", "blue", VALUES]
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), points)
    np.testing.assert_array_equal(vertex["green"], colors[:, 1])
    np.testing.assert_array_equal(vertex[VALUES], celsius)
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), faces)
    write_points(tmp_path / "points.ply", points, colors, {})
    assert "face" not in plyfile.PlyData.read(str(tmp_path / "points.ply"))
