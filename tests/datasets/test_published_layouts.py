"""Folders as published collections have them, filled with toy images, are read and checked."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_folders import write_photograph
from capture_folders import pseudo_color, rgb_image, temperatures, write_image, write_rgbt_scenes
from capture_folders import write_transforms as write_thermoscene
from dji_jpeg import linear, warm, write_dji_jpeg
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.checking.check import check
from thermosplat.prepare.importing.import_files import import_files

SIZES = {"rgb": (32, 24), "thermal": (20, 16)}


def write_sear(root: Path, count: int = 8, **changes: Any) -> Path:
    """A scene of SEAR's compilation: an object per spectrum and frame, world to camera in OpenCV's axes."""
    frames = []
    for number in range(count):
        frame: dict[str, Any] = {}
        for spectrum, folder, aside in (("rgb", "images", 0.0), ("thermal", "thermal", 0.25)):
            width, height = SIZES[spectrum]
            pose = np.eye(4)
            pose[:3, 3] = (-number - aside, 0.5, 2.0)
            frame[spectrum] = {
                "transform_matrix": pose[:3].tolist(),
                **{
                    "fl_x": 1.2 * width,
                    "fl_y": 1.3 * width,
                    "cx": width / 2,
                    "cy": height / 2,
                    "w": width,
                    "h": height,
                },
                **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0),
                **{"fovx": 45.0, "camera_angle_x": 0.8},
                "file_path": f"{folder}/{number:05d}.png",
                "depth_file_path": f"depths_{spectrum}/{number:05d}.npy",
                "type": spectrum,
            }
        write_image(root / f"images/{number:05d}.png", rgb_image(number))
        write_image(root / f"thermal/{number:05d}.png", pseudo_color(temperatures(number, *SIZES["thermal"])))
        frames.append(frame)
    frames[2]["thermal"] |= changes
    (root / "transforms.json").write_text(json.dumps({"type": "oru", "frames": frames}))
    return root


def test_each_view_of_sears_compilation_has_its_own_camera(tmp_path: Path) -> None:
    """Pose, size and intrinsics of either spectrum are those of its own object, as they are stated."""
    capture = load_capture(write_sear(tmp_path / "sink"))
    assert (len(capture.train), len(capture.test)) == (7, 1)
    views = capture.train[1].views
    for spectrum, place in (("rgb", -2.0), ("thermal", -2.25)):
        width, height = SIZES[spectrum]
        np.testing.assert_allclose(views[spectrum].viewmat[:3, 3], (place, 0.5, 2.0))
        np.testing.assert_allclose(views[spectrum].viewmat[:3, :3], np.eye(3))
        assert (views[spectrum].camera.width, views[spectrum].camera.height) == (width, height)
        assert views[spectrum].camera.K[0, 0] == pytest.approx(1.2 * width)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transform_matrix": [[1, 0], [0, 1]]}, "must be 4x4"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "no rotation"),
        ({"file_path": 5}, "must be a file name"),
        ({"k4": 0.5}, "none of its coefficients"),
    ],
)
def test_faults_of_a_views_own_camera_are_told(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    """As those of a frame are."""
    with pytest.raises(UserError, match=message):
        load_capture(write_sear(tmp_path, **changes))


@pytest.mark.parametrize("name", ["RGBT-Scenes/Dimsum", "ThermoScenes/trees", "SEAR/sink"])
def test_a_scene_of_a_published_collection_is_checked(name: str, tmp_path: Path) -> None:
    """Its folder passes ``check`` as it is, and nothing is written into it."""
    folder = tmp_path / name
    if name.startswith("RGBT"):
        write_rgbt_scenes(folder)
    elif name.startswith("Thermo"):
        write_thermoscene(folder)
    else:
        write_sear(folder)
    before = sorted(folder.rglob("*"))
    assert check(CaptureFolder(folder)).sentences
    assert sorted(folder.rglob("*")) == before


def test_a_folder_of_the_m30t_is_imported(tmp_path: Path) -> None:
    """The drone's own files: photographs _V.JPG and radiometric _T.JPG, with degrees."""
    for number in range(1, 7):
        stem, time = f"DJI_2026010112000{number}_{number:04d}", f"2026:01:01 12:00:0{number}"
        write_photograph(tmp_path / f"raw/{stem}_V.JPG", number, make="DJI", model="M30T", time=time)
        write_dji_jpeg(tmp_path / f"raw/{stem}_T.JPG", linear(warm(number)), model="M30T", time=time)
    capture = CaptureFolder(tmp_path / "capture")
    import_files(tmp_path / "raw", capture)
    for spectrum in ("rgb", "thermal"):
        assert len(list(capture.images(spectrum).glob("DJI_*"))) == 6
    assert "centi" in (capture.images("thermal") / "units.json").read_text()
    assert check(capture).sentences
