"""The rendered rig of the shared data, whose truth is known: thermal images land where they belong, without a board."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow, PairRow
from thermosplat.prepare.registration.register import register
from thermosplat.prepare.structure.sfm import run_sfm

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", "")) / "rig_desk"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not DATA.is_dir(), reason="rig_desk is not below $THERMOSPLAT_TEST_DATA")
def test_thermal_focal_length_and_poses_are_the_true_ones(tmp_path: Path) -> None:
    """All 40 pairs; the lens to 1%, and the photographs' relative rotations to 0.2°."""
    capture, truth = CaptureFolder(tmp_path), json.loads((DATA / "truth.json").read_text())
    rows, pairs = [], []
    for photograph in sorted((DATA / "visible").glob("*.jpg")):
        thermal = photograph.stem.replace("VIS", "IR") + ".png"
        for spectrum in ("rgb", "thermal"):
            capture.images(spectrum).mkdir(parents=True, exist_ok=True)
        (capture.images("rgb") / photograph.name).write_bytes(photograph.read_bytes())
        values = cv2.imread(str(DATA / "thermal" / thermal.replace(".png", ".tiff")), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(capture.images("thermal") / thermal), values)
        rows.append(FrameRow("rgb", photograph.name, photograph.name, 800, 600))
        rows.append(FrameRow("thermal", thermal, thermal, 320, 240))
        pairs.append(PairRow(photograph.name, thermal))
    capture.write_frames(rows)
    capture.write_pairs(pairs)
    run_sfm(capture)
    register(capture)
    model = pycolmap.Reconstruction(capture.sparse)
    assert model.num_reg_images() == 80
    thermal_camera = next(c for c in model.cameras.values() if c.width == 320)
    assert abs(thermal_camera.mean_focal_length() / truth["thermal"]["fx"] - 1) < 0.01
    found = {Path(i.name).name: i.cam_from_world().rotation.matrix() for i in model.images.values()}
    first, *others = sorted(truth["camera_to_world"])
    true = {name: np.array(pose)[:3, :3].T for name, pose in truth["camera_to_world"].items()}
    for name in others:
        turn = cv2.Rodrigues(found[name] @ found[first].T @ true[first] @ true[name].T)[0]
        assert np.degrees(np.linalg.norm(turn)) < 0.2
