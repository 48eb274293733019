"""Held-out views find their poses on the finished scene, which stays as it is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.evaluation.held_out_poses import evaluate_refined, held_out_motions, unrefined_sentences
from thermosplat.refinement.corrected_capture import with_moved_frames
from thermosplat.scene.model import SceneModel
from toy_run import many_frames
from toy_scene import render, toy_capture, toy_config, toy_frame, toy_model

TRUE_MOTION = torch.tensor([0.01, -0.02, 0.015, 0.01, -0.01, 0.02])


@pytest.fixture
def known() -> tuple[SceneModel, Capture, TrainConfig]:
    """A scene, and a capture whose held-out images are its own renders, from cameras that have moved since."""
    capture = toy_capture(thermal_kind="scalar", aligned=False)
    config = dataclasses.replace(toy_config(), refine=("poses",))
    model = toy_model(config, capture)
    with torch.no_grad():
        images = render(model, toy_frame(capture)).images
    frame = capture.train[0]
    views = {
        name: dataclasses.replace(view, image=images[name].clamp(0, 1).numpy(), values=None)
        for name, view in frame.views.items()
    }
    held_out = dataclasses.replace(frame, name="held out", views=views)
    capture = dataclasses.replace(many_frames(capture), test=(held_out,))
    return model, with_moved_frames(capture, {"held out": TRUE_MOTION}), config


def test_the_pose_is_found(known: tuple[SceneModel, Capture, TrainConfig]) -> None:
    """What the frame was moved by comes back with the other sign; no parameter of the scene has changed."""
    model, capture, config = known
    before = {name: value.clone() for name, value in model.state_dict().items()}
    motions = held_out_motions(model, capture, config, sh_degree=1)
    assert motions["held out"] == pytest.approx(-TRUE_MOTION, abs=2e-3)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.requires_grad and parameter.grad is None for parameter in model.parameters())


def test_a_photograph_among_placed_images_stays(known: tuple[SceneModel, Capture, TrainConfig]) -> None:
    """Thermal images alone find their poses where those that were placed are refined."""
    model, capture, config = known
    config = dataclasses.replace(config, refine=("placed",))
    assert held_out_motions(model, capture, config, sh_degree=1) == {}
    frame = capture.test[0]
    alone = dataclasses.replace(frame, name="alone", views={"thermal": frame.views["thermal"]})
    capture = dataclasses.replace(capture, test=(frame, alone))
    assert held_out_motions(model, capture, config, sh_degree=1).keys() == {"alone"}


def test_both_numbers_are_reported(known: tuple[SceneModel, Capture, TrainConfig], tmp_path: Path) -> None:
    """Numbers, table and pictures are of the poses found; the capture's own poses stand beside them."""
    model, capture, config = known
    table = tmp_path / "views.csv"
    judged = evaluate_refined(model, capture, config, sh_degree=1, csv_path=table)
    assert judged.metrics["test_poses"] == "refined on the finished scene"
    for name in ("rgb", "thermal"):
        assert judged.metrics[name]["psnr"] > judged.metrics["unrefined"][name]["psnr"] + 6
    assert f"{judged.metrics['rgb']['psnr']}" in table.read_text()
    (sentence,) = unrefined_sentences(judged.metrics)
    assert sentence.startswith("Poses of held-out views were refined on the finished scene; with those of the capture")
    assert f"RGB {judged.metrics['unrefined']['rgb']['psnr']:.2f} dB" in sentence
    moved, given = (which.test[0].views["rgb"].viewmat for which in (judged.capture, capture))
    assert not np.allclose(moved, given, atol=1e-3)


def test_poses_that_training_did_not_refine_stay(known: tuple[SceneModel, Capture, TrainConfig]) -> None:
    """Where rig or lenses alone are refined, held-out views are judged by the poses of the capture."""
    model, capture, config = known
    for refined in ((), ("rig", "intrinsics")):
        judged = evaluate_refined(model, capture, dataclasses.replace(config, refine=refined), sh_degree=1)
        assert judged.capture is capture
        assert "unrefined" not in judged.metrics
        assert unrefined_sentences(judged.metrics) == []


def test_a_pose_that_fits_is_not_made_worse(known: tuple[SceneModel, Capture, TrainConfig]) -> None:
    """Of all that was tried, no motion among it, the best is taken."""
    model, capture, config = known
    found = with_moved_frames(capture, {"held out": -TRUE_MOTION})
    motion = held_out_motions(model, found, config, sh_degree=1)["held out"]
    assert motion.abs().max() < 1e-3
