"""With ``--budget auto`` a run ends with fewer Gaussians, and with zeros that are not stored."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import AutoBudgetConfig, LossConfig, TrainConfig
from thermosplat.errors import UserError
from thermosplat.evaluation.training_views import LEARNT
from thermosplat.image_quality.metrics import psnr
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget import image_change
from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.offset_shrinkage import drop_offsets
from thermosplat.training.budget.tolerances import Tolerances
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.session.run_metrics import feature_channels, offsets_kept
from thermosplat.training.stages.auto_budget import AutoBudget
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, tolerating, toy_run_config, toy_trainer, without
from toy_scene import toy_capture, with_spectra

FRAMES = 21  # of which 20 are trained on
SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}


def budget_config(
    max_steps: int = 40,
    *,
    model: dict[str, Any] | None = None,
    spectra: dict[str, dict[str, Any]] | None = None,
    **changes: Any,
) -> TrainConfig:
    settings: dict[str, Any] = {"prune_at": (0.45,), "validate_every": 2}
    budget = AutoBudgetConfig(**(settings | changes))
    return toy_run_config(max_steps, model=model, spectra=spectra, budget="auto", auto_budget=budget)


@pytest.fixture(autouse=True)
def _toy_tolerances() -> Iterator[None]:
    with tolerating(offset_shrinkage=0.1, offset_change=0.0, measured_views=3):
        yield


def advance(trainer: Trainer, steps: int) -> None:
    while trainer.step < steps:
        trainer.train_step()


def test_pruning_ends_growth_and_frees_the_validation_views(tmp_path: Path) -> None:
    """Before: two frames are withheld and Gaussians are added. After: fewer Gaussians, no growth, all frames."""
    trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES))
    assert trainer.budget is not None
    withheld = {trainer.frames.frames[index].name for index in trainer.budget.validation}
    assert len(withheld) == 2
    assert not withheld & {trainer.schedule.frame(step).name for step in range(18)}
    advance(trainer, 17)
    before = trainer.model.num_gaussians
    assert before > 60
    assert trainer.state.budget.growing
    advance(trainer, 18)
    assert trainer.model.num_gaussians < before
    assert not trainer.state.budget.growing
    pruned = trainer.model.num_gaussians
    advance(trainer, 40)
    assert trainer.model.num_gaussians <= pruned
    assert withheld < {trainer.schedule.frame(step).name for step in range(20, 40)}  # a whole epoch of all twenty


def test_a_run_too_short_to_have_grown_is_not_cut_at_its_first_share(tmp_path: Path) -> None:
    """While Gaussians are added none are removed; the last share ends that."""
    trainer = toy_trainer(tmp_path, budget_config(prune_at=(0.25, 0.45)), many_frames(toy_capture(), FRAMES))
    advance(trainer, 9)
    before = trainer.model.num_gaussians
    advance(trainer, 10)
    assert trainer.state.budget.growing
    assert trainer.model.num_gaussians >= before
    advance(trainer, 17)
    before = trainer.model.num_gaussians
    advance(trainer, 18)
    assert not trainer.state.budget.growing
    assert trainer.model.num_gaussians < before


def test_without_shares_nothing_is_pruned_and_growth_goes_on(tmp_path: Path) -> None:
    """An empty ``prune_at`` is no share of the run, not its first step."""
    trainer = toy_trainer(tmp_path, budget_config(prune_at=()), many_frames(toy_capture(), FRAMES))
    advance(trainer, 6)
    assert trainer.state.budget.growing
    assert not trainer.state.budget.offsets_dropped
    assert trainer.model.num_gaussians > 60


def test_pruning_changes_the_images_little(tmp_path: Path) -> None:
    """Fewer Gaussians, and images within the tolerance."""
    trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES))
    assert trainer.budget is not None
    advance(trainer, 6)
    change, before = trainer.budget.images(1), trainer.model.num_gaussians
    trainer.budget.prune(1)
    assert trainer.model.num_gaussians < before
    assert change.now() <= 0.02


def test_worth_is_a_share_of_the_error_of_images_of_any_size(tmp_path: Path) -> None:
    """A Gaussian that one spectrum sees counts by how much its images change, be they small and of one channel."""
    capture = toy_capture(thermal_kind="scalar", aligned=False)  # 24x18 colours, 16x14 numbers
    capture = dataclasses.replace(capture, train=capture.train * 60)
    trainer = toy_trainer(tmp_path, budget_config(model={"feature_dim": 0}), capture)
    assert trainer.budget is not None
    gaussians = trainer.model.gaussians("shared")
    everyone = torch.arange(60)
    of_rgb, low, high = everyone < 30, torch.full((60,), -12.0), torch.full((60,), -2.0)
    visible, thermal = torch.where(of_rgb, high, low), torch.where(of_rgb, low, high)
    gaussians.set_opacity_logits(everyone, visible, {"thermal": thermal})
    change = trainer.budget.images(0)
    found = trainer.budget.scores(0, change)["shared"]
    expected = torch.zeros(60)
    for left_out in everyone:
        gaussians.set_opacity_logits(left_out[None], low[:1], {"thermal": low[:1]})
        expected[left_out] = change.now()
        gaussians.set_opacity_logits(everyone, visible, {"thermal": thermal})
    for chosen in (of_rgb, ~of_rgb):
        assert found[chosen].sum().item() == pytest.approx(expected[chosen].sum().item(), rel=0.2)


def test_growth_stops_when_validation_does_not_rise(tmp_path: Path) -> None:
    """Without the gain that is asked for, growth ends after the patience."""
    with tolerating(least_gain=1000.0, growth_looks=3):
        trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES))
    advance(trainer, 9)
    assert trainer.state.budget.growing
    assert trainer.state.budget.best_validation[0] > 0
    advance(trainer, 10)  # first look at 4, the best; at 10 the patience ends
    assert not trainer.state.budget.growing


def test_too_small_a_rise_is_none(tmp_path: Path) -> None:
    """The best stays the best until a look has gained what is asked for."""
    with tolerating(least_gain=0.5):
        trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES))
    assert trainer.budget is not None
    trainer.budget.validate(2, 1)
    best, _ = trainer.state.budget.best_validation
    for below, expected in ((0.4, best - 0.4), (0.6, best)):
        trainer.state.budget.best_validation = (best - below, 0)
        trainer.budget.validate(4, 1)
        assert trainer.state.budget.best_validation[0] == pytest.approx(expected)


def test_offsets_shrink_until_those_that_do_nothing_go(tmp_path: Path) -> None:
    """After every step before the last pruning, and after it no more."""
    capture, kept = many_frames(toy_capture(), FRAMES), {}
    for shrinkage in (0.1, 1e3):
        with tolerating(offset_shrinkage=shrinkage):
            trainer = toy_trainer(tmp_path / str(shrinkage), budget_config(), capture)
        advance(trainer, 5)
        kept[shrinkage] = offsets_kept(trainer.model)["thermal"]
    assert kept[0.1] > kept[1e3] == 0.0
    trainer = toy_trainer(tmp_path, budget_config(), capture)
    advance(trainer, 18)
    left = offsets_kept(trainer.model)
    trainer.device_step.tolerances = Tolerances(offset_shrinkage=1e3)
    advance(trainer, 20)
    assert offsets_kept(trainer.model) == left
    assert left["thermal"] > 0.0


def test_a_full_budget_ends_growth(tmp_path: Path) -> None:
    """With MCMC nothing is added once the budget is reached: the validation views come back."""
    config = budget_config()
    densification = dataclasses.replace(config.densification, strategy="mcmc", max_gaussians=63)
    config = dataclasses.replace(config, densification=densification)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(), FRAMES))
    advance(trainer, 3)
    assert trainer.state.budget.growing
    advance(trainer, 4)  # 60 and 5%
    assert trainer.model.num_gaussians == 63
    assert not trainer.state.budget.growing


def test_no_validation_views_where_there_are_too_few(tmp_path: Path) -> None:
    """Of nineteen training frames two would be more than a tenth: none is withheld."""
    trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES - 1))
    assert trainer.budget is not None
    assert trainer.budget.validation == ()


def test_cameras_that_take_turns_are_both_looked_at(tmp_path: Path) -> None:
    """Where no frame has both spectra, growth and removal are judged by images of either."""
    capture = many_frames(toy_capture(aligned=False), 41)
    frames = tuple(without(frame, "thermal" if index % 2 else "rgb") for index, frame in enumerate(capture.train))
    config = budget_config()
    with tolerating(measured_views=20):
        trainer = toy_trainer(tmp_path, config, dataclasses.replace(capture, train=frames))
    assert trainer.budget is not None
    withheld = [frames[index] for index in trainer.budget.validation]
    assert len(withheld) == 4
    assert sum("thermal" in frame.views for frame in withheld) == 2
    assert trainer.budget.images(1).errors.keys() == {"rgb", "thermal"}
    alone = dataclasses.replace(config, without=("thermal",))
    trainer = toy_trainer(tmp_path / "rgb", alone, dataclasses.replace(capture, train=frames))
    assert trainer.budget is not None
    assert len(trainer.budget.validation) == 2


def test_three_spectra_are_all_looked_at(tmp_path: Path) -> None:
    """Withheld are views of each; growth is judged by all their PSNRs, removal by the images of each."""
    capture = many_frames(toy_capture(others=("nir",), aligned=False), 61)
    shown = ("rgb", "thermal", "nir")
    frames = tuple(
        without(frame, *(name for name in shown if name != shown[index % 3]))
        for index, frame in enumerate(capture.train)
    )
    config = budget_config(spectra={"nir": {"opacity": "own"}})
    trainer = toy_trainer(tmp_path, config, dataclasses.replace(capture, train=frames))
    assert trainer.budget is not None
    withheld = [frames[index] for index in trainer.budget.validation]
    assert sorted(name for frame in withheld for name in frame.views) == sorted(2 * shown)
    change = trainer.budget.images(1)
    assert change.errors.keys() == set(shown)
    trainer.budget.validate(2, 1)
    expected = []
    for index in trainer.budget.validation:
        frame = trainer.frames[index]
        ((name, view),) = frame.views.items()
        expected.append(psnr(trainer.model.render(frame.views, sh_degree=1).images[name].detach(), view.image))
    assert trainer.state.budget.best_validation[0] == pytest.approx(sum(expected) / 6)


def test_a_gaussian_of_a_third_spectrum_has_its_worth(tmp_path: Path) -> None:
    """What near infrared alone sees counts by how much its images change, against their error."""
    capture = toy_capture(thermal_kind="scalar", others=("nir",))
    capture = dataclasses.replace(capture, train=capture.train * 60)
    config = budget_config(model={"feature_dim": 0}, spectra={"nir": {"opacity": "own"}})
    trainer = toy_trainer(tmp_path, config, capture)
    assert trainer.budget is not None
    gaussians, everyone = trainer.model.gaussians("shared"), torch.arange(60)
    low, high = torch.full((60,), -12.0), torch.full((60,), -2.0)
    seen_by = {name: everyone % 3 == place for place, name in enumerate(("rgb", "thermal", "nir"))}
    logits = {name: torch.where(mask, high, low) for name, mask in seen_by.items()}
    gaussians.set_opacity_logits(everyone, logits["rgb"], logits)
    change = trainer.budget.images(0)
    found, expected = trainer.budget.scores(0, change)["shared"], torch.zeros(60)
    for left_out in everyone:
        gaussians.set_opacity_logits(left_out[None], low[:1], dict.fromkeys(logits, low[:1]))
        expected[left_out] = change.now()
        gaussians.set_opacity_logits(everyone, logits["rgb"], logits)
    for name, chosen in seen_by.items():
        assert found[chosen].sum().item() == pytest.approx(expected[chosen].sum().item(), rel=0.2), name


def test_offsets_of_each_spectrum_go_by_its_own_images(tmp_path: Path) -> None:
    """Those that no image shows all go, of the others as many as its own images do not miss; zeros stay zero."""
    config = budget_config(spectra={"nir": {"opacity": "offset"}, "red": {"opacity": "own"}})
    with tolerating(offset_change=1e-4):
        trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(others=("nir", "red")), FRAMES))
    assert trainer.budget is not None
    gaussians = trainer.model.gaussians("shared")
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.fill_(1e-6)
        gaussians.nir_opacity_offsets.copy_(torch.linspace(-3.0, 3.0, 60))
    change = trainer.budget.images(0)
    trainer.budget.drop_offsets(0)
    kept = offsets_kept(trainer.model)
    assert list(kept) == ["thermal", "nir"]
    assert kept["thermal"] == 0.0
    assert 0.1 < kept["nir"] < 0.9
    assert 0 < change.now() <= 1e-4
    assert trainer.state.budget.offsets_dropped
    zeros = gaussians.nir_opacity_offsets == 0
    advance(trainer, 2)
    assert torch.equal(gaussians.nir_opacity_offsets == 0, zeros)


@pytest.mark.rotating("long trainings")
def test_model_gets_as_small_as_it_is(tmp_path: Path) -> None:
    """metrics.json says how small; the checkpoint holds as much, without moments, and comes back equal."""
    capture = many_frames(toy_capture(), FRAMES)
    trainer = toy_trainer(tmp_path / "auto", budget_config(), capture)
    advance(trainer, 18)  # where offsets are dropped: half of them are zero from now on
    gaussians = trainer.model.gaussians("shared")
    some = torch.arange(len(gaussians)) % 2 == 0
    drop_offsets(gaussians, "thermal", trainer.state.optimizers["shared"], some)
    trainer.train()
    metrics = json.loads(trainer.run.metrics_json.read_text())
    dense = sum(4 * parameter.numel() for parameter in trainer.model.parameters())
    assert metrics["model_bytes"] == trainer.model.num_bytes < 0.8 * dense
    assert 0.3 < metrics["opacity_offsets_kept"]["thermal"] < 0.6
    path = trainer.run.checkpoint(40)
    restored = SceneModel.from_checkpoint(load_checkpoint(path), "cpu")
    assert restored.num_bytes == metrics["model_bytes"]
    fixed = toy_trainer(tmp_path / "fixed", dataclasses.replace(budget_config(), budget="fixed"), capture)
    assert fixed.budget is None
    fixed.train()
    assert path.stat().st_size < 0.5 * fixed.run.checkpoint(40).stat().st_size


@pytest.mark.rotating
@pytest.mark.parametrize("part", ["prune", "drop_offsets", "reduce_features"])
@tolerating(offset_change=0.01, feature_change=0.05)
def test_what_memory_was_too_small_for_is_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    """A removal that memory ends is done first of all when the run goes on: it ends as one that was never stopped."""
    config, capture = budget_config(20), many_frames(toy_capture(), FRAMES)
    whole = toy_trainer(tmp_path / "whole", config, capture)
    whole.train()
    trainer = toy_trainer(tmp_path / "stopped", config, capture)

    def exhausted(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(AutoBudget, part, exhausted)
    with pytest.raises(UserError, match="Out of memory at step 10"):
        trainer.train()
    monkeypatch.undo()
    due = load_checkpoint(trainer.run.checkpoint(9)).training.budget_due
    assert due[0] == part
    resumed = Trainer.resume(config, capture, trainer.run)
    resumed.train()
    assert_same_state(state_tensors(resumed), state_tensors(whole))


def test_a_finished_run_is_trimmed_once_and_may_go_on(tmp_path: Path) -> None:
    """Resumed without a further step it stays what it is; with more steps it trains on and is trimmed again."""
    config, capture = budget_config(20), many_frames(toy_capture(), FRAMES)
    trainer = toy_trainer(tmp_path, config, capture)
    trainer.train()
    again = Trainer.resume(config, capture, trainer.run)
    again.train()
    assert_same_state(state_tensors(again), state_tensors(trainer))
    longer = Trainer.resume(dataclasses.replace(config, max_steps=24), capture, trainer.run)
    assert longer.state.budget.trimmed
    advance(longer, 22)
    assert not longer.state.budget.trimmed
    assert longer.state.checkpoint(longer.config, 1, {}).training.optimizers is not None
    longer.train()
    assert longer.state.budget.trimmed


@pytest.mark.rotating
@pytest.mark.parametrize("looks", [2, 12])
def test_interrupted_trimming_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, looks: int) -> None:
    """Ctrl-C while it is tried what may go, spherical harmonics or half of the bits: what was trained is saved."""
    trainer = toy_trainer(tmp_path, budget_config(20), many_frames(toy_capture(), FRAMES))
    advance(trainer, 20)
    before = state_tensors(trainer)
    now, done = ImageChange.now, []

    def interrupted(change: ImageChange) -> float:
        done.append(now(change))
        if len(done) == looks:
            raise KeyboardInterrupt
        return done[-1]

    monkeypatch.setattr(ImageChange, "now", interrupted)
    with pytest.raises(TrainingInterrupted):
        trainer.train()
    assert len(done) == looks
    assert_same_state(state_tensors(trainer), before)
    assert not load_checkpoint(trainer.run.checkpoint(20)).training.trimmed


def test_growth_of_a_set_that_is_trained_later(tmp_path: Path) -> None:
    """Growth ends when that of the last set has, and nobody is judged before the last one has started to grow."""
    spectra = {"rgb": {"train_until": 0.5}, "thermal": {"train_from": 0.5, "start": "rgb"}}
    config = budget_config(60, model=SEPARATE, spectra=spectra, prune_at=(0.95,))
    config = dataclasses.replace(config, densification=dataclasses.replace(config.densification, stop_step=20))
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(), FRAMES))
    advance(trainer, 32)
    assert trainer.state.budget.growing
    assert trainer.state.budget.best_validation[1] == 0
    copied = len(trainer.model.gaussians("thermal"))
    advance(trainer, 48)
    assert trainer.state.budget.growing
    assert trainer.state.budget.best_validation[1] >= 34
    assert len(trainer.model.gaussians("thermal")) != copied
    advance(trainer, 50)
    assert not trainer.state.budget.growing


@tolerating(feature_change=1e9)
def test_latent_channels_go_with_the_last_pruning(tmp_path: Path) -> None:
    """As few as the tolerance allows; metrics.json says how many, and the trained model comes back with them."""
    config = budget_config(20, prune_at=(0.45, 0.9))
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(), FRAMES))
    advance(trainer, 17)
    assert feature_channels(trainer.model) == 8
    trainer.train()
    assert feature_channels(trainer.model) == 1
    assert json.loads(trainer.run.metrics_json.read_text())["feature_channels"] == 1
    restored = SceneModel.from_checkpoint(load_checkpoint(trainer.run.checkpoint(20)), "cpu")
    assert restored.num_bytes == trainer.model.num_bytes
    frame = trainer.frames[0]
    one, other = (model.render(frame.views, sh_degree=1).images for model in (trainer.model, restored))
    assert one.keys() == other.keys() == {"rgb", "thermal"}
    assert all(torch.equal(one[name], other[name]) for name in one)


@tolerating(feature_change=0.03)
def test_channels_of_losses_count_as_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where channels are not trained on, or there are none, nothing is made of them."""
    seen = []

    def note(model: SceneModel, optimizers: object, change: ImageChange, tolerance: float) -> int:
        seen.append((change.errors.keys() - {"rgb", "thermal"}, tolerance))
        return 8

    monkeypatch.setattr("thermosplat.training.stages.auto_budget.reduce_features", note)
    config, capture = budget_config(), many_frames(toy_capture(), FRAMES)
    configs = {
        "all": config,
        "rgb": with_spectra(config, thermal={"features": 0.0}),
        "none": dataclasses.replace(config, loss=LossConfig(features=0.0)),
    }
    for name, changed in configs.items():
        trainer = toy_trainer(tmp_path / name, changed, capture)
        assert trainer.budget is not None
        trainer.budget.reduce_features(1)
    trainer = toy_trainer(tmp_path / "sh", budget_config(model={"feature_dim": 0}), capture)
    assert trainer.budget is not None
    trainer.budget.reduce_features(1)
    assert seen == [({"features_rgb", "features_thermal"}, 0.03), ({"features_rgb"}, 0.03), (set(), 0.03)]


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("stop", [7, 30])
@pytest.mark.parametrize("spectra", [{}, {"nir": {"opacity": "offset"}, "red": {"opacity": "own", "features": None}}])
@tolerating(feature_change=1e9)
def test_resumed_run_is_the_same(tmp_path: Path, stop: int, spectra: dict[str, dict[str, Any]]) -> None:
    """A run that stopped before or after pruning, which leaves one latent channel, ends as one that did not."""
    config = budget_config(spectra=spectra)
    capture = many_frames(toy_capture(others=tuple(spectra)), FRAMES)
    whole = toy_trainer(tmp_path / "whole", config, capture)
    advance(whole, 36)
    half = toy_trainer(tmp_path / "half", config, capture)
    advance(half, stop)
    half.save()
    resumed = Trainer.resume(config, capture, half.run)
    assert resumed.state.budget.best_validation == half.state.budget.best_validation
    advance(resumed, 36)
    assert_same_state(state_tensors(resumed), state_tensors(whole))


def test_nothing_goes_of_a_scene_that_is_not_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where renders are no nearer to the images than one colour, their error is no measure of what may go."""
    monkeypatch.setattr(image_change, "LEARNT", LEARNT)
    trainer = toy_trainer(tmp_path, budget_config(), many_frames(toy_capture(), FRAMES))
    advance(trainer, 17)
    before = trainer.model.num_gaussians
    advance(trainer, 18)
    assert trainer.model.num_gaussians == before
    assert not trainer.state.budget.growing
    assert "No Gaussians are removed: the scene has not learnt its thermal and RGB images" in capsys.readouterr().out
    assert trainer.budget is not None
    degrees = [gaussians.shN.clone() for gaussians in trainer.state.gaussian_sets.values()]
    trainer.budget.finish(trainer.sh_degree)
    for gaussians, shN in zip(trainer.state.gaussian_sets.values(), degrees, strict=True):
        assert torch.equal(gaussians.shN, shN)
