"""Cameras improve while training: rig, lenses and poses come back, and everything of a run knows of them."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from rendered_capture import disturbed, relief_capture, rendered_capture, trained_on_the_true_scene
from thermosplat.config import DensificationConfig, Refined
from thermosplat.config.checks import check_config
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.training.session.run_metrics import offsets_kept
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture

EVERY: tuple[Refined, ...] = ("poses", "rig", "intrinsics", "distortion")


@pytest.mark.rotating("long trainings")
def test_a_wrong_rig_and_focal_length_come_back(tmp_path: Path) -> None:
    """On the true scene, which is held, the thermal camera returns to where its images were taken from."""
    capture, scene = relief_capture()
    off = disturbed(capture, torch.tensor([0.02, -0.01, 0.015, 0.01, -0.01, 0.01]), focal=1.03)
    config = toy_run_config(
        24, refine=("rig", "intrinsics"), refine_from=0, refine_every=1, refine_first=24, log_every=100
    )
    trainer = trained_on_the_true_scene(tmp_path, config, off, scene)
    found = trainer.corrected_capture()
    for before, after, true in zip(off.train, found.train, capture.train, strict=True):
        views = [frame.views["thermal"] for frame in (before, after, true)]
        first_error, error = (np.abs(view.viewmat - views[2].viewmat).max() for view in views[:2])
        assert error < 0.1 * first_error
        assert views[1].camera.fx == pytest.approx(views[2].camera.fx, rel=0.003)
        assert after.views["rgb"].viewmat == pytest.approx(true.views["rgb"].viewmat)


def test_rounds_come_first(tmp_path: Path) -> None:
    """In two passes, cameras move every ``refine_every`` steps after ``refine_from``; then all steps follow."""
    capture, _ = relief_capture(times=2)
    held = DensificationConfig(stop_step=0)  # a reset would hide the scene
    config = toy_run_config(12, refine=("rig",), refine_from=2, refine_every=2, refine_first=9, densification=held)
    trainer = toy_trainer(tmp_path, config, capture)
    corrections = trainer.state.corrections
    assert corrections is not None
    moved, steps = [], []
    while trainer.step < config.max_steps:
        before = corrections.cameras.detach().clone()
        trainer.train_step()
        steps.append(trainer.step)
        if not torch.equal(before, corrections.cameras):
            moved.append(len(steps))
    assert moved == [4, 6, 8, 9 + 6, 9 + 8]
    assert steps == [*range(1, 9), *range(9), *range(13)]


def test_the_scene_starts_anew_with_the_cameras_that_were_found(tmp_path: Path) -> None:
    """Its steps are, to the bit, those of a run that had these cameras from the beginning; the next sitting, too."""
    capture, _ = rendered_capture()
    config = toy_run_config(
        6,
        refine=("rig", "intrinsics"),
        refine_from=0,
        refine_every=1,
        refine_first=3,
        spectra={"thermal": {"exposure": "affine"}},
    )
    trainer = toy_trainer(tmp_path / "whole", config, capture)
    for _ in range(6):
        trainer.train_step()
    corrections = trainer.state.corrections
    assert corrections is not None
    assert corrections.cameras.any()
    assert (trainer.step, trainer.state.preliminaries.find_cameras) == (0, False)
    again = toy_trainer(tmp_path / "again", config, capture)
    assert again.state.corrections is not None
    again.state.corrections.load_state_dict(corrections.state_dict())
    again.state.preliminaries.camera_passes = 0
    resumed = Trainer.resume(config, capture, trainer.run)
    for each in (trainer, again, resumed):
        while each.step < 5:
            each.train_step()
    assert_same_state(state_tensors(trainer), state_tensors(again))
    assert_same_state(state_tensors(resumed), state_tensors(again))


@pytest.mark.rotating
@pytest.mark.parametrize(("refine", "held"), [(("rig",), 8), (("poses", "distortion"), 8), (("poses",), 0), ((), 0)])
def test_spectra_have_one_opacity_while_their_cameras_are_found(
    tmp_path: Path, refine: tuple[Refined, ...], held: int
) -> None:
    """Where it is the rig or a lens that is corrected, offsets stay zero while they are found."""
    config = toy_run_config(10, refine=refine, refine_from=1, refine_every=1, refine_first=4)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(aligned=False)))
    kept = []
    while trainer.step < config.max_steps:
        trainer.train_step()
        kept.append(offsets_kept(trainer.model)["thermal"])
    assert not any(kept[:held])
    assert kept[held] > 0.9


@pytest.mark.rotating("long trainings")
@pytest.mark.parametrize(("budget", "steps"), [("fixed", 2), pytest.param("auto", 9, marks=pytest.mark.slow)])
def test_a_run_that_refines_everything(tmp_path: Path, budget: str, steps: int) -> None:
    """It trains, says what it changed, writes the cameras, and every later command sees them; so does a resumed run."""
    capture, _ = rendered_capture()
    config = toy_run_config(12, refine=EVERY, refine_from=1, refine_every=1, refine_first=3, budget=budget)
    trainer = toy_trainer(tmp_path / "whole", config, capture)
    metrics = trainer.train()
    corrections = trainer.state.corrections
    assert corrections is not None
    assert all(bool(parameter.any()) for parameter in corrections.learnt().values())
    assert metrics["test_poses"] == "refined on the finished scene"
    assert set(metrics["refined"]) == {"poses", "rig", "focal_factors", "distortion"}
    assert json.loads(trainer.run.metrics_json.read_text()) == metrics
    model = pycolmap.Reconstruction(trainer.run.refined)
    assert len(model.images) == 2 * (len(capture.train) + len(capture.test))

    half = toy_trainer(tmp_path / "half", config, capture)
    for _ in range(steps):
        half.train_step()
    half.save()
    resumed = Trainer.resume(config, capture, half.run)
    again = toy_trainer(tmp_path / "again", config, capture)
    for each in (resumed, again):
        while each.step < 12:
            each.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(again))


@pytest.mark.rotating("long trainings")
def test_a_loaded_run_has_the_corrected_capture(tmp_path: Path) -> None:
    """thermosplat-eval, -render and viewers take the cameras that training found; of another capture, its own."""
    run = tmp_path / "run"
    refine: tuple[Refined, ...] = ("poses", "rig", "intrinsics")
    config = toy_run_config(
        4, refine=refine, refine_from=0, refine_every=1, refine_first=2, data="sample", data_factor=8
    )
    capture = load_capture("sample", data_factor=8)
    trainer = toy_trainer(run, config, capture)
    while trainer.step < 4:
        trainer.train_step()
    trainer.save()
    loaded = load_run(str(run), device="cpu").capture(None)
    for ours, theirs in zip(loaded.train, trainer.corrected_capture().train, strict=True):
        for name, view in ours.views.items():
            assert np.array_equal(view.viewmat, theirs.views[name].viewmat)
            assert view.camera == theirs.views[name].camera
    assert not np.array_equal(loaded.train[0].views["rgb"].viewmat, capture.train[0].views["rgb"].viewmat)


def test_going_on_with_other_refinement_is_refused(tmp_path: Path) -> None:
    """What is refined decides which parameters there are."""
    capture = many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, toy_run_config(4, refine=("poses",)), capture)
    trainer.train_step()
    trainer.save()
    with pytest.raises(UserError, match="was trained with refine=poses, the command asks for nothing"):
        Trainer.resume(toy_run_config(4), capture, trainer.run)


def test_a_rig_needs_two_cameras() -> None:
    """A clear sentence for one spectrum alone."""
    with pytest.raises(UserError, match="--refine rig corrects how cameras stand to each other, and one spectrum"):
        check_config(toy_run_config(refine=("rig",), without=("thermal",)))


def test_passes_need_a_round() -> None:
    """A run that is too short to find cameras says so, and not one that refines poses alone, or starts with them."""
    with pytest.raises(UserError, match=r"in passes of 90 steps \(--max-steps\), and would begin at step 92"):
        check_config(toy_run_config(90, refine=("rig",)))
    with pytest.raises(UserError, match=r"in passes of 80 steps \(--refine-first\), and would begin at step 92"):
        check_config(toy_run_config(1000, refine=("rig",), refine_first=80))
    check_config(toy_run_config(90, refine=("poses",)))
    check_config(toy_run_config(90, refine=("rig",), refine_first=0))
    check_config(toy_run_config(90, refine=("distortion",), without=("thermal",)))
