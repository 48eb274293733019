"""Cameras beyond the first spectrum's find their place before a scene that is held."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from rendered_capture import disturbed, relief_capture
from thermosplat.config import Refined
from thermosplat.datasets.capture import Capture, View
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.refinement.corrected_capture import corrected_capture
from thermosplat.refinement.image_registration import PASSES, Sharpness, register_cameras, sharpness_at
from thermosplat.scene.model import SceneModel
from toy_cameras import corrections_of, tensors_of
from toy_scene import toy_config

FINE = Sharpness(0.0, 6.0, 0.0, distortion=True)
COARSE = Sharpness(0.0125, 20.0, 0.0)
RIG_AND_FOCAL: tuple[Refined, ...] = ("rig", "intrinsics")
MOTION = torch.tensor([0.02, -0.01, 0.015, 0.01, -0.01, 0.01])

Relief = tuple[Capture, SceneModel]


@pytest.fixture(scope="module")
def relief() -> Relief:
    """A capture of a relief, and the scene itself."""
    capture, scene = relief_capture()
    model = SceneModel.from_capture(toy_config(decoder={"hidden_dim": 8}), capture, "cpu")
    model.load_state_dict(scene)
    return capture, model


def registered(
    capture: Capture, model: SceneModel, refined: Sequence[Refined], rounds: Sequence[Sharpness]
) -> CameraCorrections:
    """Corrections after some rounds."""
    corrections = corrections_of(capture, *refined)
    frames = [tensors_of(capture, index) for index in range(len(capture.train))]
    for turn, sharpness in enumerate(rounds):
        register_cameras(model, corrections, frames, turn, sharpness, sh_degree=1)
    return corrections


def errors(capture: Capture, corrections: CameraCorrections, true: Capture) -> tuple[float, float]:
    """Largest error of a thermal pose, and error of the focal factor."""
    found = corrected_capture(capture, corrections)
    pairs = [(one.views["thermal"], other.views["thermal"]) for one, other in zip(found.train, true.train, strict=True)]
    pose = max(float(np.abs(one.viewmat - other.viewmat).max()) for one, other in pairs)
    return pose, abs(pairs[0][0].camera.fx / pairs[0][1].camera.fx - 1.0)


def test_a_true_camera_stays(relief: Relief) -> None:
    """What is right is not moved: neither the direction nor the focal length."""
    capture, model = relief
    pose, focal = errors(capture, registered(capture, model, RIG_AND_FOCAL, [COARSE, FINE, FINE]), capture)
    assert pose < 0.001
    assert focal < 0.0002


def test_a_wrong_camera_comes_back(relief: Relief) -> None:
    """From 1.5°, a hundredth of the extent and 3% of the focal length; the photographs' cameras stay."""
    capture, model = relief
    off = disturbed(capture, MOTION, focal=1.03)
    before = errors(off, corrections_of(off, *RIG_AND_FOCAL), capture)
    corrections = registered(off, model, RIG_AND_FOCAL, [COARSE] * 3 + [FINE] * 6)
    pose, focal = errors(off, corrections, capture)
    assert pose < 0.02 * before[0]
    assert focal < 0.001
    assert not corrections.cameras[0].any()


def test_distortion_waits(relief: Relief) -> None:
    """It stays exactly as it is in coarse rounds, and is found to be none in fine ones."""
    capture, model = relief
    off = disturbed(capture, 0.3 * MOTION, focal=1.01)
    coarse = registered(off, model, (*RIG_AND_FOCAL, "distortion"), [COARSE] * 2)
    assert coarse.camera_corrections()[1, :6].abs().max() > 0.003
    assert coarse.camera_corrections()[1, 7:].abs().max() < 1e-6
    fine = registered(off, model, (*RIG_AND_FOCAL, "distortion"), [COARSE] * 2 + [FINE] * 6)
    assert 0 < fine.camera_corrections()[1, 7:].abs().max() < 0.02
    assert errors(off, fine, capture)[1] < 0.003


def test_no_step_is_longer_than_its_limit(relief: Relief) -> None:
    """Not even one that starts far away; and the last step goes on by its momentum."""
    capture, model = relief
    off = disturbed(capture, 6.0 * MOTION, focal=1.3)
    corrections = registered(off, model, RIG_AND_FOCAL, [COARSE])
    assert 0 < corrections.cameras[1].abs().max() <= 0.02 * corrections.shared[1].camera.width + 1e-5
    torch.testing.assert_close(corrections.velocity[1], corrections.cameras[1].detach())


def test_images_that_say_nothing_move_nothing(relief: Relief) -> None:
    """Before a scene that covers no pixel."""
    capture, _ = relief
    empty = SceneModel.from_capture(toy_config(decoder={"hidden_dim": 8}), capture, "cpu")
    with torch.no_grad():
        empty.gaussians("shared").logit_opacities.fill_(-20.0)
    assert not registered(capture, empty, RIG_AND_FOCAL, [COARSE, FINE]).cameras.any()


def test_masked_pixels_say_nothing(relief: Relief) -> None:
    """A part of the images that shows something else, moved to the side, leaves cameras alone where it is masked."""
    capture, model = relief

    def with_visitor(view: View, *, masked: bool) -> View:
        image, mask = view.image.copy(), np.ones(view.image.shape[:2], np.bool_)
        part = len(image) // 2
        image[part:], mask[part:] = np.roll(image[part:], 3, axis=1), False
        return dataclasses.replace(view, image=image, mask=mask if masked else None)

    moved = []
    for masked in (False, True):
        frames = [
            dataclasses.replace(
                frame, views={**frame.views, "thermal": with_visitor(frame.views["thermal"], masked=masked)}
            )
            for frame in capture.train
        ]
        visited = dataclasses.replace(capture, train=tuple(frames))
        moved.append(errors(visited, registered(visited, model, RIG_AND_FOCAL, [COARSE, FINE]), capture)[0])
    assert moved[1] < 0.1 * moved[0]


def test_rounds_become_finer() -> None:
    """Blur and tolerance fall from stage to stage; the last one takes the rest; a second pass waits for its scene."""
    first, second = PASSES
    assert [sharpness_at(0, share) for share in (0.0, 0.2, 0.4, 1.0)] == [stage[1] for stage in first]
    assert [sharpness_at(1, share) for share in (0.0, 0.4, 1.0)] == [stage[1] for stage in second]
    assert second[0][1] is None
    stages = [sharpness for _, sharpness in first + second[1:] if sharpness is not None]
    for values in ([stage.blur for stage in stages], [stage.tolerance for stage in stages]):
        assert values == sorted(values, reverse=True)
    assert stages[-1] == dataclasses.replace(FINE, tolerance=1.5, momentum=0.3)
