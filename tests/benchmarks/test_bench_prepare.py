"""The benchmark of thermosplat-prepare: its comparison with a rig's truth, and the script."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from benchmark_scripts import run_script
from preparation.rig_truth import rig_errors
from seen_room import seen_room, write_files
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import with_thermal

LENS = {"width": 240, "height": 180, "fx": 215.0, "fy": 215.0, "cx": 118.0, "cy": 92.0, "k1": -0.15, "k2": 0.03}


@pytest.mark.parametrize(("turned", "shifted"), [(0.0, 0.0), (0.02, 0.0), (0.0, 2.0)])
def test_errors_are_those_of_the_cameras(tmp_path: Path, turned: float, shifted: float) -> None:
    """The true rig in another world has none; a turned photograph and a shifted thermal image have theirs."""
    room = seen_room(6)
    truth = {
        "thermal": {**LENS, "p1": 0, "p2": 0},
        "thermal_to_visible": np.linalg.inv(room.thermal_from_rgb).tolist(),
        "camera_to_world": {f"VIS_{k}.jpg": np.linalg.inv(viewmat).tolist() for k, viewmat in enumerate(room.viewmats)},
    }
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    model = pycolmap.Reconstruction()
    room.rgb.camera_id = 1
    model.add_camera_with_trivial_rig(room.rgb)
    for number, viewmat in enumerate(room.viewmats):
        image = pycolmap.Image(name=f"rgb/VIS_{number}.jpg", camera_id=1, image_id=number + 1)
        turn = pycolmap.Rotation3d(np.array([0.0, turned, 0.0]))
        pose = pycolmap.Rigid3d(turn, np.zeros(3)) * pycolmap.Rigid3d(viewmat[:3])
        model.add_image_with_trivial_frame(image, pose)
    lens = np.array([215.0, 118.0 + shifted, 92.0, -0.15, 0.03])
    thermal = RigCamera(room.thermal_from_rgb[:3, :3], room.thermal_from_rgb[:3, 3], lens, 240, 180)
    made = with_thermal(model, thermal, {f"VIS_{k}.jpg": f"IR_{k}.png" for k in range(6)})
    made.transform(pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0])))
    made.write(tmp_path)
    errors = rig_errors(tmp_path, tmp_path / "truth.json")
    assert errors.pairs == 6
    assert abs(errors.degrees - np.degrees(turned)) < 0.02
    if turned == 0:
        assert errors.extent < 1e-6
        assert abs(errors.pixels - shifted) < 1e-3
    else:
        assert errors.pixels > 2


def test_a_folder_that_cannot_be_prepared(tmp_path: Path) -> None:
    """What the command says is shown, and the table has the folder with nothing found."""
    (tmp_path / "nothing").mkdir()
    done = run_script("bench_prepare.py", str(tmp_path / "nothing"), "--out", str(tmp_path / "out"))
    assert done.returncode == 1
    assert "No photographs and thermal files" in done.stderr
    assert "| nothing | 0 of 0 | 0 |" in done.stdout


@pytest.mark.slow
def test_photographs_alone(tmp_path: Path) -> None:
    """All photographs of a room, beside COLMAP's own reconstruction."""
    write_files(seen_room(), tmp_path / "room")
    options = ["--photographs", str(tmp_path / "room" / "visible"), "--colmap", "--out", str(tmp_path / "out")]
    done = run_script("bench_prepare.py", *options)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "out" / "prepare.json").read_text())["rows"]
    assert row["rgb"] == row["photographs"] == 12
    assert 0 < row["colmap"]["registered"] <= 12
