"""A capture whose cameras training has corrected: what the trainer saw, in the capture's own types."""

import numpy as np
import torch

from thermosplat.refinement.corrected_capture import corrected_capture, with_moved_frames
from toy_cameras import corrections_of, set_camera, set_pose, tensors_of
from toy_run import many_frames
from toy_scene import toy_capture


def test_training_frames_are_those_that_trained() -> None:
    """Poses and intrinsics are those of the step's frames, to float32; images are untouched."""
    capture = many_frames(toy_capture(aligned=False))
    corrections = corrections_of(capture, "poses", "rig", "intrinsics", "distortion")
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in corrections.parameters():
            parameter += 0.5 * torch.randn(parameter.shape, generator=generator)
    found = corrected_capture(capture, corrections)
    for index, frame in enumerate(found.train):
        for name, seen in corrections(tensors_of(capture, index)).views.items():
            view = frame.views[name]
            np.testing.assert_allclose(view.viewmat, seen.viewmat.detach().numpy(), atol=2e-6)
            np.testing.assert_allclose(view.camera.K, seen.K.detach().numpy(), rtol=1e-6)
            assert view.camera.distortion is not None
            assert seen.distortion is not None
            np.testing.assert_allclose(view.camera.distortion, seen.distortion.detach().numpy(), rtol=1e-6)
            assert view.image is capture.train[index].views[name].image
    assert capture.train[0].views["thermal"].camera.distortion is None


def test_held_out_frames_get_what_all_have_in_common() -> None:
    """Rig and lenses, but no pose; two held-out frames stay in the same rig."""
    capture = many_frames(toy_capture(aligned=False))
    corrections = corrections_of(capture, "poses", "rig", "intrinsics")
    set_pose(corrections, 1, torch.full((6,), 0.3))
    set_camera(corrections, 1, torch.tensor([0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.05, 0.0, 0.0]))
    before, after = capture.test[0].views, corrected_capture(capture, corrections).test[0].views
    np.testing.assert_array_equal(after["rgb"].viewmat, before["rgb"].viewmat)
    shift = after["thermal"].viewmat[:3, 3] - before["thermal"].viewmat[:3, 3]
    np.testing.assert_allclose(shift, [0.1 * capture.scene_extent, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(after["thermal"].camera.fx / before["thermal"].camera.fx, np.exp(0.05), rtol=1e-4)


def test_views_of_one_camera_still_share_it() -> None:
    """Aligned frames that moved as a whole are rendered together as before."""
    capture = many_frames(toy_capture())
    corrections = corrections_of(capture, "poses")
    set_pose(corrections, 2, torch.full((6,), 0.05))
    moved = corrected_capture(capture, corrections).train[2]
    assert moved.shared_cameras == (("rgb", "thermal"),)
    assert not np.allclose(moved.views["rgb"].viewmat, capture.train[2].views["rgb"].viewmat, atol=1e-3)


def test_held_out_frames_move_as_a_whole() -> None:
    """A translation along the world's axes, in scene extents; frames that are not named stay."""
    capture = many_frames(toy_capture(aligned=False))
    motion = torch.tensor([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    moved = with_moved_frames(capture, {capture.test[0].name: motion}).test[0]
    for name, view in moved.views.items():
        before = np.linalg.inv(capture.test[0].views[name].viewmat)[:3, 3]
        shift = np.linalg.inv(view.viewmat)[:3, 3] - before
        np.testing.assert_allclose(shift, [0.1 * capture.scene_extent, 0.0, 0.0], atol=1e-6)
    assert with_moved_frames(capture, {}).test[0] is capture.test[0]
