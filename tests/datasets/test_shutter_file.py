"""shutter.json: what it may say, where times come from, and what a capture's views have of it."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from capture_folders import RIG_SIZES, rig_image, write_image, write_rgbt_scenes, write_rig
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import camera_center
from thermosplat.datasets.capture import Capture, View
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.errors import UserError
from thermosplat.novel_views.viewpoints import viewpoints

COUNT = 6


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A rig of RGB and thermal images, "0000" to "0005"."""
    write_rig(tmp_path / "rig", COUNT)
    return tmp_path / "rig"


def state(root: Path, content: Any) -> None:
    (root / "shutter.json").write_text(json.dumps(content))


def table(root: Path, rows: list[tuple[str, str]]) -> None:
    """frames.csv with the source and the time of each thermal image."""
    lines = [f"thermal,{number:04d}.png,{source},{time}" for number, (source, time) in enumerate(rows)]
    (root / "frames.csv").write_text("\n".join(["spectrum,file,source,time", *lines]) + "\n")


def views(capture: Capture, spectrum: str = "thermal") -> list[View]:
    frames = sorted((*capture.train, *capture.test), key=lambda frame: frame.name)
    return [frame.views[spectrum] for frame in frames]


def poses(view: View) -> NDArray[np.float64]:
    """World to camera at the first line and at the last."""
    assert view.readout is not None
    return view.readout.motion @ view.viewmat


def velocity(times: list[float], views: list[View], at: int) -> NDArray[np.float64]:
    """Derivative, at one of three times, of the parabola through the cameras' centres."""
    centers = np.array([camera_center(view.viewmat) for view in views])
    return np.array([np.polyval(np.polyder(np.polyfit(times, column, 2)), times[at]) for column in centers.T])


def moved(view: View) -> NDArray[np.float64]:
    """How far a camera's centre moves during the readout."""
    first, last = poses(view)
    return camera_center(last) - camera_center(first)


def test_without_the_file_images_are_taken_at_once(root: Path) -> None:
    """Nothing is assumed of a thermal camera."""
    assert all(view.readout is None for name in ("rgb", "thermal") for view in views(load_capture(root), name))


def test_even_frames_move_as_their_neighbours_say(root: Path) -> None:
    """A readout of a tenth of the interval; of the first and the last frame both neighbours are on one side."""
    state(root, {"thermal": {"readout": 0.004, "interval": 0.04, "direction": "bottom-to-top"}})
    capture = load_capture(root)
    taken = views(capture)
    for index in range(COUNT):
        start = min(max(index - 1, 0), COUNT - 3)
        expected = velocity([0.0, 0.04, 0.08], taken[start : start + 3], index - start)
        np.testing.assert_allclose(moved(taken[index]), 0.004 * expected, atol=1e-9)
        assert taken[index].readout is not None
        assert taken[index].readout.order == "bottom-to-top"
    assert all(view.readout is None for view in views(capture, "rgb"))
    assert capture.train[0].shared_cameras == (("rgb",), ("thermal",))
    (note,) = (note for note in capture.notes if "line by line" in note)
    assert "thermal images are read line by line (bottom to top): meanwhile the camera turns by" in note


def test_frames_without_a_pose_take_their_time(root: Path) -> None:
    """Between 0001 and 0002 lies an image that is not in the model: these two are two intervals apart."""
    write_image(root / "images" / "thermal" / "0001b.png", rig_image("thermal", 1))
    state(root, {"thermal": {"readout": 0.001, "interval": 0.04}})
    taken = views(load_capture(root))
    expected = velocity([0.0, 0.04, 0.12], taken[:3], 1)
    np.testing.assert_allclose(moved(taken[1]), 0.001 * expected, atol=1e-9)


def test_folders_that_share_names_are_sequences(tmp_path: Path) -> None:
    """As of two flights; the last frame of one is no neighbour of the first of the other."""
    write_rig(tmp_path, COUNT, thermal_name=lambda number: f"thermal/{'ab'[number // 3]}/{number % 3:04d}.png")
    state(tmp_path, {"thermal": {"readout": 0.01, "interval": 1.0}})
    taken = views(load_capture(tmp_path))
    for start in (0, 3):
        for at in range(3):
            expected = velocity([0.0, 1.0, 2.0], taken[start : start + 3], at)
            np.testing.assert_allclose(moved(taken[start + at]), 0.01 * expected, atol=1e-9)


def test_times_of_the_table_of_a_prepared_capture(root: Path) -> None:
    """Uneven times, and images that were not taken in the order of their names."""
    seconds = [10.0, 11.0, 9.5, 12.5, 13.0, 14.5]
    table(root, [("a.jpg", f"2026-05-01T08:00:{second:06.3f}") for second in seconds])
    state(root, {"thermal": {"readout": 0.01}})
    taken = views(load_capture(root))
    earliest = [taken[2], taken[0], taken[1]]
    for at, view in enumerate(earliest[:2]):
        np.testing.assert_allclose(moved(view), 0.01 * velocity([9.5, 10.0, 11.0], earliest, at), atol=1e-6)


def test_frames_of_two_videos(root: Path) -> None:
    """Numbers of frames times the interval; the last frame of a video is no neighbour of the first of the next."""
    sources = ["a.mp4#0", "a.mp4#30", "a.mp4#90", "b.mp4#0", "b.mp4#15", "b.mp4#30"]
    table(root, [(source, "") for source in sources])
    state(root, {"thermal": {"readout": 0.01, "interval": 1 / 30}})
    taken = views(load_capture(root))
    for start, times in ((0, [0.0, 1.0, 3.0]), (3, [0.0, 0.5, 1.0])):
        for at in range(3):
            expected = velocity(times, taken[start : start + 3], at)
            np.testing.assert_allclose(moved(taken[start + at]), 0.01 * expected, atol=1e-9)


def test_poses_that_are_stated(root: Path) -> None:
    """They are the poses at the first and the last line, whatever the model says."""
    plain = views(load_capture(root))
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.02, 0.01]))[0]
    stated = {view.path.name: [(turn @ view.viewmat).tolist(), view.viewmat.tolist()] for view in plain}
    state(root, {"thermal": {"poses": stated}})
    for view in views(load_capture(root)):
        np.testing.assert_allclose(poses(view), np.array(stated[view.path.name]), atol=1e-12)


def test_any_spectrum_and_any_layout_may_have_one(tmp_path: Path) -> None:
    """Photographs of an aligned capture: the thermal images, with the same camera, are no group with them any more."""
    root = write_rgbt_scenes(tmp_path)
    state(root, {"rgb": {"readout": 0.04, "interval": 1, "direction": "left-to-right"}, "nir": {"readout": 1}})
    frame = load_capture(root).train[0]
    assert frame.shared_cameras == (("rgb",), ("thermal",))
    (root / "shutter.json").unlink()
    assert load_capture(root).train[0].shared_cameras == (("rgb", "thermal"),)


def test_a_smaller_image_has_the_times_of_its_lines(root: Path) -> None:
    """Of 16 lines, --data-factor 2 averages two: the first is read half a line later. Tensors hold the same."""
    state(root, {"thermal": {"readout": 0.001, "interval": 0.04}})
    (_, height) = RIG_SIZES["thermal"]
    whole, half = (views(load_capture(root, data_factor=factor))[2] for factor in (1, 2))
    share = 0.5 / (height - 1)
    first, last = (camera_center(pose) for pose in poses(whole))
    found = [camera_center(pose) for pose in poses(half)]
    np.testing.assert_allclose(found[0], first + share * (last - first), atol=1e-4)
    np.testing.assert_allclose(found[1], last - share * (last - first), atol=1e-4)
    tensors = view_tensors(half, None, "cpu")
    assert half.readout is not None
    torch.testing.assert_close(tensors.readout, torch.tensor(half.readout.motion, dtype=torch.float32))
    assert tensors.line_order == "top-to-bottom"
    assert tensors.as_pinhole().readout is None


def test_renders_of_the_captures_own_views_have_its_shutter(root: Path) -> None:
    """Those of made paths have none."""
    state(root, {"thermal": {"readout": 0.002, "interval": 0.04}})
    capture = load_capture(root)
    (own, *_), (made, *_) = (
        viewpoints(capture, path, ["thermal"], num_frames=3, device="cpu") for path in ("train", "interp")
    )
    assert own.views["thermal"].readout is not None
    assert made.views["thermal"].readout is None


WRONG: dict[str, tuple[Any, str]] = {
    "a number": ({"thermal": 3}, "thermal must be an object with direction, readout, interval, poses, found 3"),
    "another key": ({"thermal": {"time": 1}}, "thermal must be an object with direction"),
    "both": ({"thermal": {"readout": 1, "poses": {}}}, "must have either readout or poses, found"),
    "neither": ({"thermal": {"interval": 1}}, "must have either readout or poses"),
    "direction": ({"thermal": {"readout": 1, "direction": "down"}}, "direction must be one of top-to-bottom,"),
    "negative": (
        {"thermal": {"readout": -1, "interval": 1}},
        "readout must be a time above 0 and at most 1e+09, found -1",
    ),
    "not finite": ({"thermal": {"readout": 1, "interval": float("inf")}}, "interval must be a time above 0"),
    "too long": ({"thermal": {"readout": 10**400, "interval": 1}}, "readout must be a time above 0 and at most 1e+09"),
    "no number": ({"thermal": {"readout": True, "interval": 1}}, "readout must be a time above 0"),
    "text": ({"thermal": {"readout": "16 ms"}}, "readout must be a time above 0"),
    "no times": ({"thermal": {"readout": 1}}, "When 0000.png was taken is not known: frames.csv has no time of it."),
    "other units": ({"thermal": {"readout": 1000, "interval": 0.1}}, "the thermal camera of 0000.png would turn by"),
    "poses": ({"thermal": {"poses": [1]}}, "poses must be an object of file names"),
    "one pose": ({"thermal": {"poses": {"0000.png": [np.eye(4).tolist()]}}}, "must be two 4x4 matrices"),
    "huge poses": ({"thermal": {"poses": {"0000.png": [[10**400] * 4] * 4}}}, "must be two 4x4 matrices"),
    "nan": ({"thermal": {"poses": {"0000.png": [np.full((4, 4), np.nan).tolist()] * 2}}}, "are no rigid motions"),
    "very long": ({"thermal": {"readout": 1e9, "interval": 1e-9}}, "while its lines are read."),
    "no poses": ({"thermal": {"poses": {}}}, "thermal has no poses of 6 of 6 images (first: 0000.png)."),
    "scaled": ({"thermal": {"poses": {"0000.png": [(2 * np.eye(4)).tolist()] * 2}}}, "no rigid motions from the world"),
    "mirrored": (
        {"thermal": {"poses": {"0000.png": [np.diag([1.0, 1.0, -1.0, 1.0]).tolist()] * 2}}},
        "are no rigid motions from the world to the camera.",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_explained(root: Path, name: str) -> None:
    """One sentence says what was expected and found."""
    content, message = WRONG[name]
    state(root, content)
    with pytest.raises(UserError) as caught:
        load_capture(root)
    assert message in caught.value.message


def test_images_of_one_time_and_lone_ones_are_explained(root: Path) -> None:
    """Neither says how the camera moves."""
    times = ["2026-05-01T08:00:01"] * 2 + [f"2026-05-01T08:00:0{second}" for second in range(2, 6)]
    table(root, [("a.jpg", time) for time in times])
    state(root, {"thermal": {"readout": 0.01}})
    with pytest.raises(UserError, match=r"0000.png and 0001.png were taken at the same time, by frames.csv"):
        load_capture(root)
    table(root, [("a.mp4#1", "")] + [(f"b.mp4#{number}", "") for number in range(5)])
    state(root, {"thermal": {"readout": 0.01, "interval": 1}})
    with pytest.raises(UserError, match=r"0000.png has no image before or after it in time"):
        load_capture(root)
    table(root, [(f"b.mp4#{'9' * 400}", "")] + [(f"b.mp4#{number}", "") for number in range(5)])
    with pytest.raises(UserError, match=r"0000.png has no image before or after it in time"):
        load_capture(root)


def test_a_file_that_is_no_json(root: Path) -> None:
    """It ends the command with its name."""
    (root / "shutter.json").write_text("{thermal:")
    with pytest.raises(UserError, match=r"shutter.json is not readable JSON"):
        load_capture(root)
