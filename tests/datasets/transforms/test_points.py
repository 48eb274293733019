"""Where the starting points of a transforms capture come from."""

import json

import numpy as np
import pytest

from capture_folders import synthetic_model, write_model, write_transforms
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import camera_center
from thermosplat.errors import UserError

plyfile = pytest.importorskip("plyfile", reason='plyfile is not installed (pip install ".[test]")')


def write_ply(path, points, colors, *, text=False):
    dtype = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.zeros(len(points), dtype)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, channel]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=text).write(path)


@pytest.mark.parametrize(("name", "text"), [("sparse_pc.ply", False), ("cloud.ply", True)])
def test_point_cloud_of_the_file(tmp_path, name, text):
    """ply_file_path or sparse_pc.ply, binary or text."""
    generator = np.random.default_rng(0)
    points = generator.normal(size=(20, 3)).astype(np.float32)
    colors = generator.integers(0, 256, (20, 3), np.uint8)
    write_ply(tmp_path / name, points, colors, text=text)
    write_transforms(tmp_path, **({} if name == "sparse_pc.ply" else {"ply_file_path": name}))
    capture = load_capture(tmp_path)
    order, expected = np.argsort(capture.points[:, 0]), np.argsort(points[:, 0])
    np.testing.assert_allclose(capture.points[order], points[expected], atol=1e-5)
    np.testing.assert_array_equal(capture.point_colors[order], colors[expected])
    assert capture.notes == ()


def test_unreadable_point_cloud(tmp_path):
    """A PLY that is none is a UserError with its name."""
    write_transforms(tmp_path)
    (tmp_path / "sparse_pc.ply").write_text("no ply")
    with pytest.raises(UserError, match=r"sparse_pc\.ply is not a readable point cloud"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("agrees", "folder"), [(True, "images"), (False, "images"), (True, "undistorted"), (True, "images/left")]
)
def test_points_of_a_model_beside_it(tmp_path, agrees, folder):
    """COLMAP's points are taken through applied_transform, if its cameras then are the file's, in whatever folder."""
    model = synthetic_model(8)
    content = write_transforms(tmp_path)
    (tmp_path / "images").rename(tmp_path / "moved")
    (tmp_path / folder).parent.mkdir(exist_ok=True)
    (tmp_path / "moved").rename(tmp_path / folder)
    applied = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
    content["applied_transform"] = applied.tolist()
    for image in model.images.values():
        number = image.frame_id - 1
        frame = content["frames"][number]
        image.name = frame["file_path"].split("/")[1]
        frame["file_path"] = f"{folder}/{image.name}"
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose = np.vstack([applied[:, :3] @ pose[:3], [0, 0, 0, 1]]) @ np.diag([1, -1, -1, 1])
        if not agrees:
            pose[:3, 3] += [0, 0, 5.0 * number]
        frame["transform_matrix"] = pose.tolist()
    write_model(model, tmp_path / "colmap" / "sparse" / "0")
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    if agrees:
        expected = np.array([point.xyz for point in model.points3D.values()]) @ applied[:, :3].T
        np.testing.assert_allclose(np.sort(capture.points, 0), np.sort(expected, 0), atol=1e-5)
        assert capture.notes == ()
    else:
        assert len(capture.points) > 1000
        assert any("other poses" in note for note in capture.notes)


def test_random_points_are_said_and_repeatable(tmp_path):
    """Without any cloud: points around the cameras, the same every time, and a note."""
    write_transforms(tmp_path)
    first, second = load_capture(tmp_path), load_capture(tmp_path)
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.point_colors, second.point_colors)
    assert any("random points" in note for note in first.notes)
    mean = np.mean([camera_center(frame.views["rgb"].viewmat) for frame in (*first.train, *first.test)], axis=0)
    np.testing.assert_allclose(first.points.mean(0), mean, atol=0.2)


@pytest.mark.parametrize("name", ["cloud.ply", "sparse_pc.ply"])
def test_a_cloud_that_is_named_and_missing(tmp_path, name):
    """The note has its name, once."""
    write_transforms(tmp_path, ply_file_path=name)
    notes = load_capture(tmp_path).notes
    missing = f"ply_file_path of transforms_thermal.json is {name}, which does not exist."
    assert notes.count(missing) == 1
    assert any("random points" in note for note in notes)


def test_a_model_without_points_beside_it(tmp_path):
    """That is the reason, not its poses."""
    write_transforms(tmp_path)
    model = synthetic_model(8)
    for point in list(model.points3D):
        model.delete_point3D(point)
    write_model(model, tmp_path / "sparse" / "0")
    assert any("has 0 points: it is not used" in note for note in load_capture(tmp_path).notes)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"ply_file_path": 5}, r"ply_file_path of .*transforms_thermal\.json must be a file name, found 5"),
        ({"applied_transform": [1, 2]}, r"applied_transform of .* must be a 3x4 matrix of numbers, found \[1, 2\]"),
        ({"applied_transform": "flip"}, "applied_transform of .* must be a 3x4 matrix of numbers, found 'flip'"),
    ],
)
def test_wrong_kinds_of_values(tmp_path, content, says):
    """Told with the key and what was found."""
    write_transforms(tmp_path, **content)
    write_model(synthetic_model(8), tmp_path / "sparse" / "0")
    with pytest.raises(UserError, match=says) as caught:
        load_capture(tmp_path)
    assert caught.value.hint
