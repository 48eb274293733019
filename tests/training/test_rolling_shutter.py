"""Training on images that are read line by line: against images made of the lines of cameras at rest."""

import dataclasses
from pathlib import Path
from typing import get_args

import pytest
import torch

from rendered_capture import relief_capture, trained_on_the_true_scene
from rolling_captures import filmed, shaken
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import frame_tensors, packed, packed_elsewhere
from thermosplat.datasets.readouts import LineOrder
from thermosplat.evaluation.held_out import rendered_views
from thermosplat.scene.model import SceneModel
from thermosplat.training.recorded_steps import frame_shape
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture, toy_config

BARREL = LensCoefficients("pinhole", (-0.25, 0.05, 0.0, 0.0, 0.0, 0.0), (0.01, -0.01))


def relief(order: LineOrder = "top-to-bottom", **how: object) -> tuple[Capture, SceneModel]:
    """A capture of smooth colours whose thermal images a rolling shutter records, and the true scene."""
    capture, scene = relief_capture(**how)
    model = SceneModel.from_capture(toy_config(decoder={"hidden_dim": 8}), capture, "cpu")
    model.load_state_dict(scene)
    return filmed(shaken(capture, ("thermal",), order), model), model


def at_rest(capture: Capture) -> Capture:
    """The capture as if all its images were taken at once."""

    def still(frame: Frame) -> Frame:
        views = {name: dataclasses.replace(view, readout=None) for name, view in frame.views.items()}
        return Frame(frame.name, views)

    train, test = (tuple(map(still, frames)) for frames in (capture.train, capture.test))
    return dataclasses.replace(capture, train=train, test=test)


def errors(model: SceneModel, capture: Capture) -> dict[str, float]:
    """Median errors of the held-out views, by spectrum.

    The median, since a rolling shutter sorts Gaussians by depth once, and line by line they are sorted for each line:
    where two of a depth overlap, single pixels differ.
    """
    views = rendered_views(model, capture.test[0], capture.scales, 1)
    return {view.spectrum: float((view.image - view.target).detach().abs().median()) for view in views}


@pytest.mark.rotating
@pytest.mark.parametrize("order", get_args(LineOrder))
def test_the_true_scene_shows_what_is_read_line_by_line(order: LineOrder) -> None:
    """Whichever line is first. As if taken at once, the same scene is at least five times as far off."""
    capture, model = relief(order)
    assert errors(model, capture)["rgb"] == 0.0
    assert errors(model, capture)["thermal"] < 0.2 * errors(model, at_rest(capture))["thermal"]


@pytest.mark.slow
def test_photographs_have_shutters_and_lenses_too() -> None:
    """Both spectra behind lenses, with decoders that see the direction of each line's pixels."""
    capture, _ = relief_capture(lenses={"rgb": BARREL, "thermal": BARREL})
    config = toy_config(decoder={"hidden_dim": 8, "view_direction": True})
    model = SceneModel.from_capture(config, capture, "cpu")
    with torch.no_grad():
        model.gaussians("shared").features.normal_(generator=torch.Generator().manual_seed(0))
    capture = filmed(shaken(capture, ("rgb", "thermal"), "bottom-to-top"), model)
    found, still = errors(model, capture), errors(model, at_rest(capture))
    assert {name: found[name] < 0.2 * still[name] for name in found} == {"rgb": True, "thermal": True}


@pytest.mark.rotating("long trainings")
def test_training_through_the_shutter_keeps_the_true_scene(tmp_path: Path) -> None:
    """Colours that fit stay; trained as if images were taken at once, they are bent to what the shutter did."""
    capture, model = relief()
    scene = {name: value.clone() for name, value in model.state_dict().items()}
    found = {}
    for name, seen in (("known", capture), ("unknown", at_rest(capture))):
        rates = {"features_lr": 1.0, "features_lr_final": 1.0}
        trainer = trained_on_the_true_scene(tmp_path / name, toy_run_config(40), seen, scene, **rates)
        found[name] = errors(trainer.model, seen)["thermal"]
    assert found["known"] < 0.5 * found["unknown"]


def test_a_packed_frame_keeps_its_readout() -> None:
    """It lies in the frame's memory, so that a step that is replayed has the motion of its own frame."""
    capture = shaken(many_frames(toy_capture(aligned=False)), ("thermal",))
    frame = packed(frame_tensors(capture.train[0], capture.scales, "cpu"))
    copy = packed_elsewhere(frame)
    assert copy.memory is not None
    copy.memory.zero_()
    assert frame.views["rgb"].readout is None
    expected = torch.tensor(capture.train[0].views["thermal"].readout.motion, dtype=torch.float32)
    torch.testing.assert_close(frame.views["thermal"].readout, expected)
    assert not copy.views["thermal"].readout.any()


def test_frames_with_other_line_orders_or_lenses_are_other_work() -> None:
    """A captured step is replayed for no frame whose lines are read in another order, though its tensors are alike."""
    capture = many_frames(toy_capture(aligned=False))
    shapes = []
    for order in get_args(LineOrder):
        frame = shaken(capture, ("thermal",), order).train[0]
        shapes.append(frame_shape(packed(frame_tensors(frame, capture.scales, "cpu"))))
    assert len(set(shapes)) == 4
    again = shaken(capture, ("thermal",), "top-to-bottom", degrees=5.0).train[1]
    assert frame_shape(packed(frame_tensors(again, capture.scales, "cpu"))) == shapes[0]


@pytest.mark.rotating("resumed runs")
def test_a_resumed_run_is_the_same(tmp_path: Path) -> None:
    """Bit for bit."""
    capture = shaken(many_frames(toy_capture(aligned=False)), ("thermal",))
    config = toy_run_config(8)
    half = toy_trainer(tmp_path / "half", config, capture)
    while half.step < 4:
        half.train_step()
    half.save()
    resumed = Trainer.resume(config, capture, half.run)
    again = toy_trainer(tmp_path / "again", config, capture)
    for trainer in (resumed, again):
        while trainer.step < 8:
            trainer.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(again))
