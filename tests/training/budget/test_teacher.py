"""Held spectra are trained on what the scene showed when withheld views were best."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import AutoBudgetConfig, DensificationConfig, TrainConfig
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.capture import Capture
from thermosplat.rasterizer.pair_capacity import CALLS
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.budget.teacher import Teacher, may_teach
from thermosplat.training.frames.shrunk_frames import area_averages, shrunk_frame
from thermosplat.training.new_scenes import NewScenes
from thermosplat.training.sharing.shares import shares_of
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from toy_run import (
    enlarged,
    many_frames,
    state_tensors,
    step_gradients,
    through,
    tolerating,
    toy_run_config,
    toy_trainer,
)
from toy_scene import toy_capture, toy_config, toy_frame, toy_model

TAUGHT = StepKind(0, densifying=False, taught=("rgb",))


def still(max_steps: int, **changes: Any) -> TrainConfig:
    """A run whose budget and density control do nothing else."""
    budget = AutoBudgetConfig(prune_at=())
    settings = {"budget": "auto", "auto_budget": budget, "densification": DensificationConfig(stop_step=0)}
    return toy_run_config(max_steps, **(settings | changes))


@pytest.fixture(autouse=True)
def _nothing_else() -> Iterator[None]:
    with tolerating(offset_shrinkage=0.0, sh_change=0.0, rounding_change=0.0, noise_floor=0.0, held_change=0.0):
        yield


def taught(path: Path, config: TrainConfig, capture: Capture | None = None, floor: float = 0.1) -> Trainer:
    """A trainer whose RGB is held at the scene that it begins with, with its colours turned around."""
    trainer = toy_trainer(path, config, many_frames(toy_capture()) if capture is None else capture)
    teacher = Teacher.of_now(trainer.model, 0)
    with torch.no_grad():
        for name, parameter in teacher.model.named_parameters():
            if name.endswith("sh0"):
                parameter.neg_()
    watch = NoiseWatch({"rgb": floor}, len(trainer.frames), trainer.device)
    watch.held, watch.teachers, watch.over = ("rgb",), {"rgb": teacher}, True
    trainer.state.noise_watch = watch
    return trainer


def errors_against(trainer: Trainer, *, teacher: bool) -> float:
    """Mean squared error of the RGB images that the model renders, against the teacher's or the photographs."""
    assert trainer.state.noise_watch is not None
    found = []
    for frame in trainer.frames:
        target = trainer.state.noise_watch.teachers["rgb"].targets("rgb", frame, None) if teacher else frame
        with torch.no_grad():
            rendered = trainer.model.render(frame.views, sh_degree=0, shared_cameras=frame.shared_cameras)
        image = target.views["rgb"].image
        assert image is not None
        found.append((rendered.images["rgb"].clamp(0, 1) - image).square().mean().item())
    return sum(found) / len(found)


def gradients(trainer: Trainer, kind: StepKind = TAUGHT) -> dict[str, torch.Tensor]:
    """Gradients of a step on the first frame, by parameter."""
    trainer.state.clear_gradients()
    step_gradients(trainer, kind)
    model = trainer.model.named_parameters()
    return {name: parameter.grad.clone() for name, parameter in model if parameter.grad is not None}


@pytest.mark.parametrize("feature_dim", [16, 0])
@pytest.mark.parametrize("aligned", [True, False])
def test_shows_the_scene_of_then(feature_dim: int, aligned: bool) -> None:
    """Its image is what the model rendered beside its other spectra; later steps change nothing of it."""
    capture = toy_capture(aligned=aligned)
    model, frame = toy_model(toy_config(feature_dim=feature_dim), capture), toy_frame(capture)
    with torch.no_grad():
        before = model.render(frame.views, sh_degree=1, shared_cameras=frame.shared_cameras)
    teacher = Teacher.of_now(model, 1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.5)
    for name in ("rgb", "thermal"):
        shown = teacher.targets(name, frame, None)
        torch.testing.assert_close(shown.views[name].image, before.images[name].clamp(0, 1))
        (other,) = {"rgb", "thermal"} - {name}
        assert shown.views[other] is frame.views[other]
    intensity = teacher.targets("thermal", frame, None).views["thermal"].intensity
    if feature_dim:
        first = model.spectra["thermal"].latent[0]
        torch.testing.assert_close(intensity, before.features["thermal"][..., first].clamp(0, 1))
    else:
        assert intensity is frame.views["thermal"].intensity


def test_shows_frames_of_any_size() -> None:
    """A smaller frame has a smaller image of the same scene."""
    capture = enlarged(toy_capture(), 4)
    frame, teacher = toy_frame(capture), Teacher.of_now(toy_model(toy_config(), capture), 0)
    small = shrunk_frame(frame, capture.train[0].views, 2.0)
    image = teacher.targets("rgb", small, None).views["rgb"].image
    whole = teacher.targets("rgb", frame, None).views["rgb"].image
    assert image is not None
    assert whole is not None
    assert image.shape == (36, 48, 3)
    assert (image - area_averages(whole, 48, 36)).abs().mean() < 0.1 * image.std()


def test_shows_exposures_as_they_are(tmp_path: Path) -> None:
    """A view that came out too bright is one of the teacher's, too."""
    config = still(10, spectra={"rgb": {"exposure": "affine"}})
    trainer = taught(tmp_path, config)
    exposures, frame = trainer.state.exposures, trainer.frames[0]
    assert exposures is not None
    assert trainer.state.noise_watch is not None
    teacher = trainer.state.noise_watch.teachers["rgb"]
    with torch.no_grad():
        exposures.maps["rgb"][0, :, -1] = 0.04
        mean = exposures.maps["rgb"].mean(dim=0)[:, -1]
        plain = teacher.model.render({"rgb": frame.views["rgb"]}, sh_degree=0).images["rgb"]
    image = teacher.targets("rgb", frame, exposures).views["rgb"].image
    torch.testing.assert_close(image, (plain + 0.04 - mean).clamp(0, 1))
    assert image is not None
    assert not image.requires_grad


@pytest.mark.rotating
@pytest.mark.parametrize("batch_size", [None, 2])
def test_a_held_spectrum_is_trained_on_what_its_teacher_shows(tmp_path: Path, batch_size: int | None) -> None:
    """It comes nearer to that, and away from the photographs; what is noted are errors against photographs."""
    trainer = taught(tmp_path, still(60, batch_size=batch_size))
    near, far = errors_against(trainer, teacher=True), errors_against(trainer, teacher=False)
    while trainer.step < 60 // (batch_size or 1):
        trainer.train_step()
    assert errors_against(trainer, teacher=True) < 0.5 * near
    noted = trainer.state.noise_watch
    assert noted is not None
    assert noted.errors["rgb"].mean().item() == pytest.approx(errors_against(trainer, teacher=False), rel=0.1)
    assert abs(far - near) > 0.01


def test_other_spectra_are_trained_on_their_images(tmp_path: Path) -> None:
    """Gradients of a taught step are those of one whose photograph is the teacher's image."""
    trainer = taught(tmp_path / "a", still(10))
    found = gradients(trainer)
    assert trainer.state.noise_watch is not None
    shown = trainer.state.noise_watch.teachers["rgb"].targets("rgb", trainer.frames[0], None)
    other = toy_trainer(tmp_path / "b", still(10), many_frames(toy_capture()))
    other.state.clear_gradients()
    step_gradients(other, StepKind(0, densifying=False), shown)
    expected = {name: value.grad for name, value in other.model.named_parameters() if value.grad is not None}
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        assert torch.equal(found[name], gradient), name


def test_small_changes_are_left_to_the_other_spectra(tmp_path: Path) -> None:
    """Below the share of the error that the view had at its best, RGB has no gradient; its error is not the noise's."""
    trainer = taught(tmp_path / "a", still(10))
    near = errors_against(trainer, teacher=True)
    with tolerating(held_change=0.01):
        above = taught(tmp_path / "b", still(10), floor=10 * near)
    with tolerating(held_change=0.5):
        below = taught(tmp_path / "c", still(10), floor=10 * near)
    sh0 = next(name for name in gradients(trainer) if name.endswith("sh0"))
    assert torch.equal(gradients(above)[sh0], gradients(trainer)[sh0])
    assert gradients(below)[sh0].abs().max() == 0
    offsets = next(name for name in gradients(below) if name.endswith("opacity_offsets"))
    assert gradients(below)[offsets].abs().max() > 0


def test_changes_are_measured_against_photographs(tmp_path: Path) -> None:
    """What a budget may leave out has the same unit, taught or not."""
    trainer = taught(tmp_path, still(10))
    assert trainer.budget is not None
    images = trainer.budget.images(0)  # type: ignore[attr-defined]
    assert images.errors["rgb"] == pytest.approx(errors_against(trainer, teacher=False), rel=1e-5)


def test_state_goes_on(tmp_path: Path) -> None:
    """A resumed run has the same teacher. A finished one has none, and trained further is held by floors."""
    config = still(6)
    trainer = taught(tmp_path / "a", config)
    while trainer.step < 3:
        trainer.train_step()
    trainer.save()
    resumed = Trainer.resume(config, trainer.capture, trainer.run)
    ours, theirs = state_tensors(resumed), state_tensors(trainer)
    assert any(".noise_watch.teachers.rgb" in name for name in theirs)
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    resumed.train()
    (*_, last) = resumed.run.checkpoints()
    saved = load_checkpoint(last).training.noise_watch
    assert saved is not None
    assert (saved["teachers"], saved["best_teachers"]) == ({}, {})
    further = Trainer.resume(still(9), trainer.capture, resumed.run)
    assert further.state.taught == ()
    assert further.state.noise_watch is not None
    assert further.state.noise_watch.held == ("rgb",)


def test_a_resumed_teacher_sees_as_the_scene_does(tmp_path: Path) -> None:
    """Of a scene that is trained through a lens: its pinhole views, too, by the unscented transform."""
    barrel = LensCoefficients("pinhole", (-0.25, 0.05, 0.0, 0.0, 0.0, 0.0), (0.01, -0.01))
    capture = through(many_frames(toy_capture(aligned=False)), {"thermal": barrel})
    trainer = taught(tmp_path, still(6), capture)
    trainer.save()
    resumed = Trainer.resume(still(6), capture, trainer.run)
    shown = []
    for watch in (trainer.state.noise_watch, resumed.state.noise_watch):
        assert watch is not None
        shown.append(watch.teachers["rgb"].targets("rgb", trainer.frames[0], None).views["rgb"].image)
    assert shown[0] is not None
    assert torch.equal(shown[0], shown[1])


def test_where_there_is_no_room_floors_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that has no teacher, or may no longer have one, is held by floors alone."""
    watch = NoiseWatch({"rgb": 0.01}, 2, torch.device("cpu"))
    watch.errors["rgb"].fill_(0.02)
    watch.judge(100, {"rgb": 20.0}, 0.05, 100, lambda: None)
    assert watch.judge(300, {"rgb": 19.0}, 0.05, 100, lambda: None) == ["rgb"]
    assert watch.teachers == {}
    assert watch.floors_of(torch.tensor(0), 0.0)["rgb"].item() == pytest.approx(0.02)
    trainer = taught(tmp_path, still(6))
    trainer.save()
    monkeypatch.setattr(NewScenes, "may_teach", lambda self, model: False)
    resumed = Trainer.resume(still(6), trainer.capture, trainer.run)
    assert resumed.state.taught == ()


def test_shares_of_ranks_have_no_teacher(tmp_path: Path) -> None:
    """Ranks hold spectra by floors: none gets a whole scene that it would forget at once."""
    trainer = taught(tmp_path, still(6))
    for share in shares_of(load_checkpoint(trainer.save()), 2):
        assert share.training.noise_watch is not None
        assert share.training.noise_watch["held"] == ("rgb",)
        assert share.training.noise_watch["teachers"] == {}


def test_as_many_renders_as_fit_into_a_step() -> None:
    """Two of each spectrum."""
    few, many = toy_capture(), toy_capture(others=tuple(f"band{k}" for k in range(CALLS // 2 - 1)))
    assert may_teach(toy_model(toy_config(), few))
    more = toy_config(feature_dim=0, spectra={name: {} for name in many.scales if name.startswith("band")})
    assert not may_teach(toy_model(more, many))


@pytest.mark.cuda
def test_captured_steps_train_on_what_a_teacher_shows(tmp_path: Path) -> None:
    """Graphs from before a spectrum is held give way to ones that render the teacher."""
    config = dataclasses.replace(still(120), device="cuda")
    trainer = toy_trainer(tmp_path / "a", config, many_frames(toy_capture()))
    while trainer.step < 40:
        trainer.train_step()
    assert trainer.steps.recordings is not None
    assert {work.kind.taught for work in trainer.steps.recordings.graphs} == {()}
    other = taught(tmp_path / "b", config)
    trainer.state.noise_watch = other.state.noise_watch
    near = errors_against(trainer, teacher=True)
    while trainer.step < 120:
        trainer.train_step()
    assert {work.kind.taught for work in trainer.steps.recordings.graphs} == {("rgb",)}
    assert trainer.guard.first_bad() is None
    assert errors_against(trainer, teacher=True) < 0.5 * near
