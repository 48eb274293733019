"""The benchmark of thermal images of another hour: errors against the truth, and images that are left out."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from benchmark_scripts import run_script
from flown_model import flight
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import with_unpaired


@pytest.mark.tooling
def test_placed_and_left_out(tmp_path: Path) -> None:
    """One image is right, one is off by ten pixels, one is missing."""
    made = flight(points=300)
    photographs = [image for image in made.model.images.values() if image.has_pose]
    to_world = {
        Path(i.name).name: np.vstack([i.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]) for i in photographs
    }
    lens = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 120.0}
    names = sorted(to_world)[:3]
    truth = {
        "thermal": lens | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "thermal_to_visible": np.eye(4).tolist(),
        "camera_to_world": {name: pose.tolist() for name, pose in to_world.items()},
    }
    night = truth | {
        "camera_to_world": {f"N{name.replace('.', '_V.')}": truth["camera_to_world"][name] for name in names}
    }
    poses = {f"N{Path(name).stem}_T.png": pycolmap.Rigid3d(np.linalg.inv(to_world[name])[:3]) for name in names[:2]}
    wrong = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 10 / 300, 0.0])), np.zeros(3))
    poses[f"N{Path(names[1]).stem}_T.png"] = wrong * poses[f"N{Path(names[1]).stem}_T.png"]
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    with_unpaired(made.model, RigCamera.looking_along(320, 240, 300.0), poses).write(sparse)
    for name, content in (("day", truth), ("night", night)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    done = run_script("bench_placing.py", str(tmp_path), str(tmp_path / "day.json"), str(tmp_path / "night.json"))
    assert done.returncode == 0, done.stderr
    assert "2 of 3 placed: 1 within 2 px, 1 beyond 6 px" in done.stdout
    assert f"N{Path(names[2]).stem}_T: left out" in done.stdout
