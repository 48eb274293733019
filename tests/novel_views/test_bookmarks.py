"""Bookmarks go through their file unchanged, and a path through them begins and ends at them."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.novel_views.bookmarks import Bookmark, fov_camera, path_through, read_bookmarks, write_bookmarks
from thermosplat.novel_views.camera_paths import look_to
from thermosplat.novel_views.viewpoints import bookmarked_viewpoints
from thermosplat.viewer.front_end import Shared
from thermosplat.viewer.layers import LayerRenderer
from thermosplat.viewer.turns import OneAtATime
from thermosplat.viewer.viewed_scene import ViewedScene
from toy_run import many_frames
from toy_scene import toy_capture, toy_config, toy_model


def far(x: float) -> list[list[float]]:
    viewmat = np.eye(4)
    viewmat[0, 3] = x
    return viewmat.tolist()


def bookmark(name: str, x: float, fov_y: float = 40.0) -> Bookmark:
    viewmat = look_to(np.array([x, 0.2, -4.0]), np.array([-x, 0.0, 4.0]), np.array([0.0, -1.0, 0.0]))
    return Bookmark(name, viewmat, fov_y)


def test_a_file_keeps_bookmarks(tmp_path: Path) -> None:
    """What is read is what was written, in its order."""
    written = [bookmark("Fenster über der Tür", 1.0, 33.25), bookmark("b", -2.0)]
    write_bookmarks(tmp_path / "bookmarks.json", written)
    read = read_bookmarks(tmp_path / "bookmarks.json")
    assert [(b.name, b.fov_y) for b in read] == [(b.name, b.fov_y) for b in written]
    for one, other in zip(read, written, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)


def test_files_have_the_worlds_views(tmp_path: Path) -> None:
    """What a viewer of a scene far from the world's origin saves is shown again from the same places."""
    capture = dataclasses.replace(many_frames(toy_capture()), placement=Placement((5e5, 4.6e6, 300.0), 8.0))
    model = toy_model(toy_config(), capture)
    scene = ViewedScene("toy", model, 1, dict(capture.scales), torch.device("cpu"), capture)
    saved = [bookmark("a", 1.0), bookmark("b", -1.0)]
    Shared(LayerRenderer(scene), tmp_path, OneAtATime(), bookmarks=saved).save_bookmarks()
    read = read_bookmarks(tmp_path / "bookmarks.json")
    center = np.linalg.inv(read[0].viewmat)[:3, 3]
    np.testing.assert_allclose(center, capture.placement.to_world(np.array([1.0, 0.2, -4.0])), atol=1e-6)
    first, last = bookmarked_viewpoints(capture, read, ["rgb"], num_frames=2, device="cpu")
    for point, one in ((first, saved[0]), (last, saved[1])):
        np.testing.assert_allclose(point.views["rgb"].viewmat, one.viewmat, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "x"}, "not a bookmarks file"),
        ({"version": 2}, "version 2"),
        ({"bookmarks": []}, "no bookmarks"),
        ({"bookmarks": [{"name": "a", "fov_y": 40}]}, "bookmark 1 lacks"),
        ({"bookmarks": [{"name": "a", "fov_y": 40, "viewmat": [[1, 2], [3, 4]]}]}, "4 by 4"),
        ({"bookmarks": [{"name": "a", "fov_y": 40, "viewmat": (2 * np.eye(4)).tolist()}]}, "no rotation"),
        ({"bookmarks": [{"name": "a", "fov_y": 180, "viewmat": np.eye(4).tolist()}]}, "between 0.1 and 179"),
        ({"bookmarks": [{"name": "a", "fov_y": 1e-300, "viewmat": np.eye(4).tolist()}]}, "between 0.1 and 179"),
        ({"bookmarks": [{"name": "a", "fov_y": 40, "viewmat": far(1e300)}]}, "lies further away than 1e"),
        ({"bookmarks": [{"name": "a", "fov_y": 40, "viewmat": far(2e9)}]}, "lies further away than 1e"),
    ],
)
def test_what_is_no_bookmarks_file_is_told(change: dict, said: str, tmp_path: Path) -> None:
    """Each mistake has its own sentence."""
    write_bookmarks(tmp_path / "b.json", [bookmark("a", 1.0)])
    content = json.loads((tmp_path / "b.json").read_text()) | change
    (tmp_path / "b.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=said):
        read_bookmarks(tmp_path / "b.json")


def test_what_is_no_file_is_told(tmp_path: Path) -> None:
    """A missing file, and one that is no JSON."""
    with pytest.raises(UserError, match="Cannot read the bookmarks"):
        read_bookmarks(tmp_path / "none.json")
    (tmp_path / "b.json").write_text("{")
    with pytest.raises(UserError, match="no JSON"):
        read_bookmarks(tmp_path / "b.json")


def test_a_path_goes_through_the_bookmarks() -> None:
    """It starts and ends at the outer ones, passes the inner one, and its field of view passes theirs."""
    keys = [bookmark("a", -1.0, 30.0), bookmark("b", 0.0, 60.0), bookmark("c", 2.0, 40.0)]
    path = path_through(keys, 61)
    assert len(path) == 61
    np.testing.assert_allclose(path[0].viewmat, keys[0].viewmat, atol=1e-9)
    np.testing.assert_allclose(path[-1].viewmat, keys[-1].viewmat, atol=1e-9)
    assert path[0].fov_y == 30.0
    assert path[-1].fov_y == 40.0
    centers = np.array([np.linalg.inv(b.viewmat)[:3, 3] for b in path])
    nearest = np.linalg.norm(centers - np.linalg.inv(keys[1].viewmat)[:3, 3], axis=1).argmin()
    assert path[nearest].fov_y == pytest.approx(60.0, abs=0.1)
    with pytest.raises(UserError, match="at least two"):
        path_through(keys[:1], 10)


def test_the_camera_of_a_field_of_view() -> None:
    """A point at half the angle above the axis falls on the upper edge, at any size."""
    for width, height in ((200, 150), (1920, 1080)):
        camera = fov_camera(50.0, width, height)
        y = camera.fy * np.tan(np.radians(-25.0)) + camera.cy
        assert y == pytest.approx(0.0, abs=1e-9)
        assert (camera.cx, camera.width, camera.height) == (width / 2, width, height)
