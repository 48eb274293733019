"""The capture of a known rig that the refinement's benchmark writes and judges."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from preparation.rig_capture import Disturbance, thermal_errors, write_capture
from thermosplat.config import TrainConfig
from thermosplat.datasets import load_capture


def lens(width: int, height: int, focal: float, k1: float, k2: float) -> dict[str, float]:
    """A lens as truth.json has it."""
    center = {"cx": width / 2, "cy": height / 2}
    return {"width": width, "height": height, "fx": focal, "fy": focal, **center, "k1": k1, "k2": k2}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Five pairs of noise, their truth, and a model with points."""
    rng, poses = np.random.default_rng(1), {}
    for number in range(5):
        (tmp_path / "visible").mkdir(exist_ok=True)
        (tmp_path / "thermal").mkdir(exist_ok=True)
        pose = np.eye(4)
        pose[:3, 3] = 0.2 * number, 0.05 * number**2, 0.02 * number**3
        poses[f"VIS_{number}.jpg"] = pose.tolist()
        photograph = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
        counts = rng.integers(28000, 31000, (240, 320), dtype=np.uint16)
        cv2.imwrite(str(tmp_path / "visible" / f"VIS_{number}.jpg"), photograph)
        cv2.imwrite(str(tmp_path / "thermal" / f"IR_{number}.tiff"), counts)
    rig = np.eye(4)
    rig[:3, 3] = 0.05, -0.02, 0.01
    lenses = {"visible": lens(80, 60, 75.0, -0.1, 0.03), "thermal": lens(320, 240, 277.0, -0.24, 0.07)}
    truth = {**lenses, "thermal_to_visible": rig.tolist(), "camera_to_world": poses}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    model = pycolmap.Reconstruction()
    for place in rng.normal((0.0, 0.0, 3.0), 1.0, (40, 3)):
        model.add_point3D(place, pycolmap.Track(), np.array([90, 90, 90], np.uint8))
    (tmp_path / "points").mkdir()
    model.write_text(tmp_path / "points")
    return tmp_path


@pytest.mark.parametrize(
    ("wrong", "least", "most"),
    [(Disturbance(), 0.0, 1e-6), (Disturbance(1.0, 0.02, 1.05), 4.0, 20.0), (Disturbance(focal_factor=1.01), 0.5, 1.5)],
)
def test_errors_are_those_of_the_disturbance(source: Path, wrong: Disturbance, least: float, most: float) -> None:
    """None with the true rig, whose images are half as large; pixels of the untouched image with a wrong one."""
    write_capture(source, source / "points", source / "capture", wrong, (1, 2))
    capture = load_capture(source / "capture", spectra=TrainConfig().spectra)
    median = float(np.median(thermal_errors(source, capture, capture, wrong)))
    assert least <= median <= most
    direct = load_capture(source / "capture", spectra=TrainConfig().spectra, lens="direct")
    assert float(np.median(thermal_errors(source, direct, direct, wrong))) == pytest.approx(median, abs=1e-6)
    height, width = capture.train[0].views["thermal"].image.shape[:2]
    assert abs(width - 160) < 40
    assert abs(height - 120) < 40


def test_where_the_scene_lies_as_a_whole_is_no_error_of_poses(source: Path) -> None:
    """Cameras that all turned and moved as one are right, where poses were wrong; where the rig was, they are not."""
    write_capture(source, source / "points", source / "capture", Disturbance(), (1, 2))
    capture = load_capture(source / "capture", spectra=TrainConfig().spectra)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = cv2.Rodrigues(np.radians([0.3, -0.2, 0.4]))[0], (0.01, 0.0, -0.02)
    frames = tuple(
        replace(frame, views={name: replace(view, viewmat=view.viewmat @ turn) for name, view in frame.views.items()})
        for frame in capture.train
    )
    moved = replace(capture, train=frames)
    assert thermal_errors(source, moved, capture, Disturbance(pose_degrees=0.3)).max() < 1e-6
    assert np.median(thermal_errors(source, moved, capture, Disturbance(degrees=1.0))) > 1.0
