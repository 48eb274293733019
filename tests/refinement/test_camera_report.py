"""What refining changed, in numbers, in sentences, and as a COLMAP model."""

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from thermosplat.datasets.placement import Placement
from thermosplat.refinement.camera_report import correction_sentences, correction_summary, write_cameras
from thermosplat.refinement.corrected_capture import corrected_capture
from toy_cameras import corrections_of, set_camera, set_pose
from toy_run import many_frames
from toy_scene import toy_capture


def test_the_summary_has_degrees_and_world_units() -> None:
    """Of a known motion; only of what was refined."""
    capture = many_frames(toy_capture(aligned=False))
    corrections = corrections_of(capture, "rig", "intrinsics")
    set_camera(corrections, 1, torch.tensor([0.02, 0.0, 0.0, 0.0, 0.03, 0.04, np.log(1.05), 0.0, 0.0]))
    summary = correction_summary(corrections)
    assert set(summary) == {"rig", "focal_factors"}
    (rig,) = summary["rig"]["thermal"]
    assert rig["degrees"] == pytest.approx(np.degrees(0.02), rel=1e-3)
    assert rig["distance"] == pytest.approx(0.05 * capture.scene_extent, rel=1e-3)
    assert summary["focal_factors"] == {"thermal": [pytest.approx(1.05, rel=1e-4)]}
    assert correction_sentences(summary) == [
        f"Rig: thermal turned by 1.146° and moved by {rig['distance']:.4g} world units.",
        "Focal lengths of thermal: times 1.0500.",
    ]


@pytest.mark.parametrize(("factor", "lost"), [(0.96, False), (1.2, False), (0.7, True), (4.8, True)])
def test_a_camera_that_was_lost_is_said(factor: float, lost: bool) -> None:
    """Where its focal length changed by more than calibrations are off."""
    said = " ".join(correction_sentences({"focal_factors": {"thermal": [factor]}}))
    assert ("The camera of thermal was probably not found" in said) == lost


def test_poses_are_told_by_their_medians() -> None:
    """What all frames have in common does not count."""
    capture = many_frames(toy_capture())
    corrections = corrections_of(capture, "poses", "distortion")
    for index, shift in enumerate((0.1, 0.3, 0.1, 0.3)):
        set_pose(corrections, index, torch.tensor([0.0, 0.0, 0.0, shift, 0.0, 0.0]))
    summary = correction_summary(corrections)
    assert summary["poses"]["median_distance"] == pytest.approx(0.1 * capture.scene_extent, rel=1e-3)
    assert summary["poses"]["median_degrees"] == pytest.approx(0.0, abs=1e-3)
    sentences = correction_sentences(summary)
    distance = f"{summary['poses']['median_distance']:.4g}"
    assert sentences[0] == f"Poses of the frames: changed by 0.000° and {distance} world units in the median."
    assert sentences[1] == "Distortion left in RGB: k1 +0.0000 k2 +0.0000."
    assert correction_sentences({}) == []


def test_lengths_and_poses_are_the_worlds(tmp_path: Path) -> None:
    """Of a scene that is trained in a frame of its own."""
    capture = dataclasses.replace(many_frames(toy_capture()), placement=Placement((5e5, 4.6e6, 300.0), 8.0))
    corrections = corrections_of(capture, "poses")
    set_pose(corrections, 0, torch.tensor([0.0, 0.0, 0.0, 0.4, 0.0, 0.0]))
    distance = correction_summary(corrections)["poses"]["median_distance"]
    assert distance == pytest.approx(8 * 0.1 * capture.scene_extent, rel=1e-3)
    write_cameras(capture, tmp_path / "refined")
    found = pycolmap.Reconstruction(tmp_path / "refined").images[1].cam_from_world().inverse().translation
    view = next(iter(capture.train[0].views.values()))
    np.testing.assert_allclose(found, capture.placement.to_world(np.linalg.inv(view.viewmat)[:3, 3]), atol=1e-8)


@pytest.mark.parametrize("bent", [False, True])
def test_the_model_reads_back(tmp_path: Path, bent: bool) -> None:
    """By COLMAP itself: every view of both splits with its pose and lens."""
    capture = many_frames(toy_capture(aligned=False))
    corrections = corrections_of(capture, "poses", "distortion") if bent else corrections_of(capture, "poses")
    for index in range(4):
        set_pose(corrections, index, 0.05 * torch.rand(6, generator=torch.Generator().manual_seed(index)))
    if bent:
        set_camera(corrections, 0, torch.tensor([0.0] * 7 + [0.01, 0.0]))
    corrected = corrected_capture(capture, corrections)
    write_cameras(corrected, tmp_path / "refined")
    model = pycolmap.Reconstruction(tmp_path / "refined")
    views = [view for frame in (*corrected.train, *corrected.test) for view in frame.views.values()]
    assert len(model.images) == len(views)
    for number, view in enumerate(views, start=1):
        image = model.images[number]
        np.testing.assert_allclose(image.cam_from_world().matrix(), view.viewmat[:3], atol=1e-9)
        camera = model.cameras[image.camera_id]
        assert camera.model.name == ("OPENCV" if bent else "PINHOLE")
        np.testing.assert_allclose(camera.calibration_matrix(), view.camera.K, rtol=1e-12)
        if bent:
            assert camera.params[4] == pytest.approx(0.01 if view.spectrum == "rgb" else 0.0, abs=1e-5)
