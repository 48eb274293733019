"""Corrections of cameras: what each kind moves, what stays exactly as it is, and what gradients reach."""

import dataclasses

import numpy as np
import pytest
import torch

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.refinement.camera_motion import rigid_motion
from toy_cameras import SPECTRA, corrections_of, set_camera, set_pose, tensors_of
from toy_run import many_frames
from toy_scene import toy_capture

MOTION = torch.tensor([0.02, -0.01, 0.03, 0.1, 0.2, -0.1])


@pytest.fixture
def capture() -> Capture:
    """Four training frames of two cameras each."""
    return many_frames(toy_capture(aligned=False))


def test_nothing_learnt_changes_no_bit(capture: Capture) -> None:
    """Before the first update every camera is the capture's."""
    corrections = corrections_of(capture, "poses", "rig", "intrinsics")
    for index in range(len(capture.train)):
        frame = tensors_of(capture, index)
        for name, view in corrections(frame).views.items():
            assert torch.equal(view.viewmat, frame.views[name].viewmat)
            assert torch.equal(view.K, frame.views[name].K)
            assert view.distortion is None


def test_poses_move_single_frames(capture: Capture) -> None:
    """The frame that moves leaves the others where they are, but for the mean of all, which is held."""
    corrections = corrections_of(capture, "poses")
    set_pose(corrections, 1, MOTION)
    torch.testing.assert_close(corrections.pose_motions()[1], 0.75 * MOTION, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(corrections.pose_motions()[0], -0.25 * MOTION, atol=1e-5, rtol=1e-4)
    frame = tensors_of(capture, 1)
    centers = [
        torch.linalg.inv(view.viewmat.double())[:3, 3].detach()
        for view in (frame.views["rgb"], corrections(frame).views["rgb"])
    ]
    shift = (centers[1] - centers[0]) / capture.scene_extent
    torch.testing.assert_close(shift.float(), 0.75 * MOTION[3:], atol=1e-5, rtol=1e-3)


def test_placed_frames_move_alone(capture: Capture) -> None:
    """A frame without a photograph moves, and by all it is said to: no mean is taken off. The others stay."""
    placed = dataclasses.replace(capture.train[1], views={"thermal": capture.train[1].views["thermal"]})
    capture = dataclasses.replace(capture, train=(capture.train[0], placed, *capture.train[2:]))
    corrections = corrections_of(capture, "placed")
    assert corrections.pose_basis.flatten(1).any(dim=1).tolist() == [False, True, False, False]
    assert list(corrections.learnt()) == ["poses"]
    set_pose(corrections, 1, MOTION)
    torch.testing.assert_close(corrections.pose_motions()[1], MOTION, atol=1e-5, rtol=1e-4)
    for index in (0, 2, 3):
        frame = tensors_of(capture, index)
        for name, view in corrections(frame).views.items():
            assert torch.equal(view.viewmat, frame.views[name].viewmat)
    frame = tensors_of(capture, 1)
    assert not torch.equal(corrections(frame).views["thermal"].viewmat, frame.views["thermal"].viewmat)


def test_what_all_poses_have_in_common_moves_nothing(capture: Capture) -> None:
    """The scene stays where the capture has it."""
    corrections = corrections_of(capture, "poses")
    for index in range(4):
        set_pose(corrections, index, MOTION)
    frame = tensors_of(capture, 0)
    for name, view in corrections(frame).views.items():
        torch.testing.assert_close(view.viewmat, frame.views[name].viewmat, atol=1e-5, rtol=0)


def test_the_rig_moves_every_camera_but_the_first(capture: Capture) -> None:
    """One rigid motion in the axes of the thermal camera, the same in all frames."""
    corrections = corrections_of(capture, "rig")
    assert not corrections.camera_basis[0].any()
    set_camera(corrections, 1, torch.cat([MOTION, torch.zeros(3)]))
    for index in (0, 3):
        frame = tensors_of(capture, index)
        views = corrections(frame).views
        assert torch.equal(views["rgb"].viewmat, frame.views["rgb"].viewmat)
        expected = rigid_motion(MOTION, capture.scene_extent) @ frame.views["thermal"].viewmat
        torch.testing.assert_close(views["thermal"].viewmat, expected, atol=1e-5, rtol=1e-4)


def test_lenses_belong_to_their_cameras(capture: Capture) -> None:
    """A factor per spectrum and intrinsics, on both focal lengths and on nothing else."""
    corrections = corrections_of(capture, "intrinsics", "distortion")
    assert [shared.spectrum for shared in corrections.shared] == SPECTRA
    set_camera(corrections, 1, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.01, -0.02]))
    frame = tensors_of(capture, 2)
    views = corrections(frame).views
    assert torch.equal(views["rgb"].K, frame.views["rgb"].K)
    expected = frame.views["thermal"].K.clone()
    expected[0, 0] *= np.exp(0.05)
    expected[1, 1] *= np.exp(0.05)
    torch.testing.assert_close(views["thermal"].K, expected, atol=1e-4, rtol=1e-4)
    assert views["thermal"].distortion is not None
    assert views["thermal"].distortion.tolist() == pytest.approx([0.01, -0.02], abs=1e-4)
    assert torch.equal(views["thermal"].viewmat, frame.views["thermal"].viewmat)


def test_cameras_that_no_longer_agree_are_rendered_apart() -> None:
    """Frames of one shared camera: moving them as a whole keeps it shared, a rig or a lens of its own does not."""
    capture = many_frames(toy_capture())
    frame = tensors_of(capture, 0)
    assert frame.shared_cameras == (("rgb", "thermal"),)
    assert corrections_of(capture, "poses")(frame).shared_cameras == frame.shared_cameras
    for refined in ("rig", "intrinsics", "distortion"):
        assert corrections_of(capture, refined)(frame).shared_cameras == (("rgb",), ("thermal",))


def test_views_of_frames_that_did_not_train(capture: Capture) -> None:
    """They get rig and lens. A camera that no training frame has gets those of its spectrum's only camera."""
    corrections = corrections_of(capture, "poses", "rig", "intrinsics")
    set_pose(corrections, 0, MOTION)
    set_camera(corrections, 1, torch.tensor([*MOTION.tolist(), 0.05, 0.0, 0.0]))
    view = capture.test[0].views["thermal"]
    tensors = frame_tensors(capture.test[0], capture.scales, "cpu").views["thermal"]
    for camera in (view.camera, view.camera.resized(8, 7)):
        found = corrections.of_camera("thermal", tensors, camera)
        assert (found.K[0, 0] / tensors.K[0, 0]).item() == pytest.approx(np.exp(0.05), rel=1e-4)
        expected = rigid_motion(MOTION, capture.scene_extent) @ tensors.viewmat
        torch.testing.assert_close(found.viewmat, expected, atol=1e-5, rtol=1e-4)


def test_only_what_is_refined_is_learnt(capture: Capture) -> None:
    """The names are those of the learning rates; gradients reach these parameters and no others."""
    assert list(corrections_of(capture, "poses").learnt()) == ["poses"]
    assert not corrections_of(capture, "rig", "intrinsics").learnt()  # the thermal camera is registered
    corrections = corrections_of(capture, "rig", "intrinsics", "distortion")
    assert list(corrections.learnt()) == ["cameras"]
    views = corrections(tensors_of(capture, 1)).views
    sum((view.viewmat.sum() + view.K.sum() + view.distortion.sum()) for view in views.values()).backward()  # type: ignore[union-attr]
    assert corrections.cameras.grad is not None
    assert not corrections.cameras.grad[0, :6].any()  # the first camera of the rig
    assert corrections.cameras.grad[0, 6] == 0  # nor does it zoom
    assert corrections.cameras.grad[0, 7:].abs().min() > 0
    assert not corrections.cameras.grad[1].any()
    assert corrections.poses.grad is None


def test_cameras_of_other_spectra_are_registered(capture: Capture) -> None:
    """Those with something to find; the first spectrum's are learnt by gradients."""
    assert corrections_of(capture, "poses").registered == ()
    corrections = corrections_of(capture, "rig", "intrinsics")
    assert corrections.registered == (1,)
    assert list(corrections.free_coordinates(1)) == list(range(7))
    assert list(corrections.frames_of(1)) == [0, 1, 2, 3]
    assert list(corrections_of(capture, "distortion").free_coordinates(1)) == [7, 8]


def test_the_only_spectrum_zooms(capture: Capture) -> None:
    """Beside other spectra the first one's focal lengths are what theirs are measured by; alone it has its own."""
    assert corrections_of(capture, "intrinsics").zoomed == ("thermal",)
    alone = CameraCorrections(("intrinsics",), capture, ["rgb"])
    assert alone.zoomed == ("rgb",)
    set_camera(alone, 0, torch.tensor([0.0] * 6 + [0.05, 0.0, 0.0]))
    frame = tensors_of(capture, 1)
    views = alone(dataclasses.replace(frame, views={"rgb": frame.views["rgb"]})).views
    assert (views["rgb"].K[0, 0] / frame.views["rgb"].K[0, 0]).item() == pytest.approx(np.exp(0.05), rel=1e-4)


def test_a_frame_that_does_not_train_has_no_corrections(capture: Capture) -> None:
    """A programmer's mistake, not a user's."""
    frame = frame_tensors(capture.test[0], capture.scales, "cpu")
    with pytest.raises(ValueError, match="Frame frame0 is not one of those that train"):
        corrections_of(capture, "poses")(frame)
