"""Frames and captures in memory."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from capture_folders import write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig

CAMERA = Camera(10.0, 10.0, 2.0, 2.0, 4, 4)


def view(spectrum, position=(0.0, 0.0, 0.0), camera=CAMERA) -> View:
    viewmat = np.eye(4)
    viewmat[:3, 3] = -np.array(position)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    return View(spectrum, "a", Path("a.png"), camera, viewmat, image)


def frame(name, *views) -> Frame:
    return Frame(name, {view.spectrum: view for view in views})


def capture(*frames, points=((0.0, 0.0, 3.0),) * 4) -> Capture:
    points = np.array(points, np.float32)
    return Capture("c", Path("c"), "colmap", frames, (), points, np.zeros(points.shape, np.uint8), {})


def test_aligned_means_same_camera_size_and_pose():
    """Only a pair that shares everything is one traversal."""
    assert frame("a", view("rgb"), view("thermal")).aligned
    assert not frame("a", view("rgb"), view("thermal", (0, 0, 0.1))).aligned
    assert not frame("a", view("rgb"), view("thermal", camera=CAMERA.resized(2, 2))).aligned
    assert not frame("a", view("rgb")).aligned
    assert not frame("a", view("rgb"), view("thermal"), view("nir", (0, 0, 0.1))).aligned


def test_spectra_that_share_a_camera_are_grouped():
    """One group per traversal, each in the order of the views; views of another pose or size are apart."""
    moved, small = (0, 0, 0.1), CAMERA.resized(2, 2)
    rgb, thermal, nir = view("rgb"), view("thermal", moved), view("nir")
    assert frame("a", rgb, thermal, nir).shared_cameras == (("rgb", "nir"), ("thermal",))
    assert frame("a", rgb, thermal, view("nir", moved)).shared_cameras == (("rgb",), ("thermal", "nir"))
    assert frame("a", rgb, nir, view("red_edge", camera=small)).shared_cameras == (("rgb", "nir"), ("red_edge",))
    assert frame("a", thermal).shared_cameras == (("thermal",),)
    assert frame("a").shared_cameras == ()


def test_scene_extent_is_3dgs_radius():
    """1.1 times the largest distance of a train camera from the cameras' mean."""
    frames = [frame(str(x), view("rgb", (x, 0, 0))) for x in (0.0, 1.0, 5.0)]
    assert capture(*frames).scene_extent == pytest.approx(1.1 * 3.0)


def test_scene_extent_is_computed_once(monkeypatch):
    """Every training step asks for it, and it goes through all cameras."""
    whole = capture(*(frame(str(x), view("rgb", (x, 0, 0))) for x in (0.0, 1.0)))
    first = whole.scene_extent
    monkeypatch.setattr("thermosplat.datasets.capture.scene_extent", lambda *_: pytest.fail("computed again"))
    assert whole.scene_extent == first


def test_scene_extent_of_one_position_falls_back_to_the_points():
    """A tripod has no camera spread; the points' distance stands in."""
    frames = [frame(str(n), view("rgb"), view("thermal")) for n in range(3)]
    assert capture(*frames).scene_extent == pytest.approx(1.1 * 3.0)


def test_require_accepts_what_is_there():
    """Nothing is raised for spectra that exist, nor for those that nobody needs."""
    several = capture(frame("a", view("rgb")), frame("b", view("thermal")))
    several.require(["rgb", "thermal"])
    several.require(["rgb"])
    several.require([])


def test_short_representations():
    """A prompt shows what there is, not the pixels."""
    whole = capture(frame("a", view("rgb"), view("thermal")), frame("b", view("rgb")))
    assert repr(whole) == "Capture('c', colmap, 2 train + 0 test frames, 2 RGB + 1 thermal views, 4 points, 0 notes)"
    shown = "Frame('b', View(rgb 'a', 4x4 px, 3 channels))"
    assert repr(whole.train[1]) == shown
    assert repr(Frame("d", {})) == "Frame('d', no views)"
    scalar = dataclasses.replace(view("thermal"), image=np.zeros((4, 4, 1), np.float32), values=np.zeros((4, 4)))
    assert repr(scalar) == "View(thermal 'a', 4x4 px, 1 channel, with values)"
    multispectral = dataclasses.replace(whole, spectra=dict.fromkeys(("rgb", "thermal", "red_edge"), SpectrumConfig()))
    assert "2 RGB + 1 thermal + 0 red edge views" in repr(multispectral)


def test_a_loaded_capture_has_a_short_representation(tmp_path):
    """The whole of it on one line."""
    assert len(repr(load_capture(write_rgbt_scenes(tmp_path)))) < 200


@pytest.mark.parametrize("factor", [2.5, 0, -1, "2", None])
def test_data_factors_are_whole_numbers(tmp_path, factor):
    """2.5 would shrink by something else than it says."""
    with pytest.raises(UserError, match=r"must be a whole number of at least 1, got"):
        load_capture(write_rgbt_scenes(tmp_path, 2), data_factor=factor)


@pytest.mark.parametrize("data", ["x" * 5000, "a\0b", "/dev/null"])
def test_folders_of_impossible_names(data):
    """No system's error reaches the user."""
    with pytest.raises(UserError, match=r"The capture .* (does not exist|is a file, not a folder)") as caught:
        load_capture(data)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("data", ["caf\udce9", "."])
def test_a_folder_whose_name_is_not_utf8(data, tmp_path, monkeypatch):
    """Neither pycolmap nor a configuration can have it, also where it is the current folder."""
    folder = tmp_path / "caf\udce9"
    folder.mkdir()
    monkeypatch.chdir(folder if data == "." else tmp_path)
    with pytest.raises(UserError, match="is not UTF-8"):
        load_capture(data)


def test_a_folder_that_cannot_be_read(tmp_path, monkeypatch):
    """The system's reason, and the path."""

    def denied(*_):
        raise PermissionError(13, "Permission denied", str(tmp_path / "images"))

    monkeypatch.setattr("thermosplat.datasets.list_capture", denied)
    with pytest.raises(UserError, match=r"Cannot read .*images: Permission denied"):
        load_capture(tmp_path)
