"""Noisy spectra are held where withheld views were best."""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.training.budget.noise_watch import NOISY, SOON_NOISY, NoiseWatch
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture

LOSS, PATIENCE = 0.05, 100
FRAMES = 41  # of which 40 are trained on
NOISE = 0.2
"""Variance, about the error that a toy run begins with."""


def watch_with(errors: list[float], noise: float = 0.01) -> NoiseWatch:
    """Of RGB alone, with the errors that frames had; 0 where they were not trained on."""
    watch = NoiseWatch({"rgb": noise}, len(errors), torch.device("cpu"))
    watch.errors["rgb"].copy_(torch.tensor(errors))
    return watch


def test_floors_rise_to_the_errors_of_the_best_step() -> None:
    """Each frame's to its own; those of withheld frames to the mean of the others; no floor falls."""
    watch = watch_with([0.02, 0.0, 0.015, 0.007])
    assert watch.judge(100, {"rgb": 20.0}, LOSS, PATIENCE) == []
    watch.errors["rgb"].copy_(torch.tensor([0.012, 0.0, 0.012, 0.006]))
    assert watch.judge(200, {"rgb": 19.9}, LOSS, PATIENCE) == ["rgb"]
    assert watch.held == ("rgb",)
    assert watch.floors["rgb"].tolist() == pytest.approx([0.02, 0.014, 0.015, 0.01])
    assert not watch.watches()
    assert watch.judge(900, {"rgb": 1.0}, LOSS, PATIENCE) == []


@pytest.mark.parametrize(
    ("step", "psnr", "error"),
    [
        (199, 19.9, 0.02),  # too early
        (200, 19.96, 0.02),  # too little
        (200, 20.1, 0.02),  # better
        (200, 19.9, 0.01 / NOISY + 1e-4),  # not noise
    ],
)
def test_others_go_on(step: int, psnr: float, error: float) -> None:
    """What is not worse for long, by enough, or is not made of noise."""
    watch = watch_with([error, error])
    watch.judge(100, {"rgb": 20.0}, LOSS, PATIENCE)
    assert watch.judge(step, {"rgb": psnr, "thermal": 0.0}, LOSS, PATIENCE) == []
    assert watch.floors["rgb"].tolist() == pytest.approx([0.01, 0.01])
    assert watch.watches()


@pytest.mark.parametrize(("share", "watched"), [(1.1 * SOON_NOISY, True), (0.9 * SOON_NOISY, False), (0.0, False)])
def test_watches_what_may_become_noisy(share: float, watched: bool) -> None:
    """Of less noise, or before the first step, no best is noted and no scene is kept."""
    watch, kept = watch_with([0.01 / share if share else 0.0] * 2), []
    watch.judge(100, {"rgb": 20.0}, LOSS, PATIENCE, lambda: kept.append(1))
    assert watch.watches() == watched
    assert len(kept) == watched


def test_state_goes_on() -> None:
    """Another watch that takes it over decides and holds as the first one."""
    watch = watch_with([0.02, 0.015])
    watch.judge(100, {"rgb": 20.0}, LOSS, PATIENCE)
    other = NoiseWatch(watch.noise, 2, torch.device("cpu"))
    other.load_state_dict(copy.deepcopy(watch.state_dict()))
    for one in (watch, other):
        one.errors["rgb"].fill_(0.011)
        assert one.judge(300, {"rgb": 19.0}, LOSS, PATIENCE) == ["rgb"]
    assert torch.equal(watch.floors["rgb"], other.floors["rgb"])
    other.forget()
    assert other.floors["rgb"].tolist() == pytest.approx([0.01, 0.01])
    assert (other.held, other.over) == ((), False)
    with pytest.raises(ValueError, match="one number for each of 3 frames"):
        NoiseWatch(watch.noise, 3, torch.device("cpu")).load_state_dict(watch.state_dict())


@pytest.fixture
def worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Withheld views lose a decibel of RGB in every step."""
    judge = NoiseWatch.judge

    def judged(watch: NoiseWatch, step: int, psnrs: dict[str, float], *others: Any) -> list[str]:
        return judge(watch, step, psnrs | {"rgb": 50.0 - step}, *others)

    monkeypatch.setattr(NoiseWatch, "judge", judged)


def watched(**changes: float) -> TrainConfig:
    """A short run that withholds two frames, and whose growth ends at once."""
    settings = {"prune_at": (0.2,), "validation_views": 2, "validate_every": 2, "measured_views": 3, "patience": 1}
    return toy_run_config(100, budget="auto", auto_budget=AutoBudgetConfig(**(settings | changes)))  # type: ignore[arg-type]


def noisy_run(folder: Path, config: TrainConfig, noise: float, frames: int = FRAMES) -> Trainer:
    """With that variance of noise in RGB, whatever its images have."""
    trainer = toy_trainer(folder, config, many_frames(toy_capture(), frames))
    trainer.state.noise_watch = NoiseWatch({"rgb": noise}, len(trainer.frames), trainer.device)
    return trainer


def advance(trainer: Trainer, steps: int) -> Trainer:
    """The trainer, so many steps from its start."""
    while trainer.step < steps:
        trainer._train_step()
    return trainer


def shown(trainer: Trainer, start: int, end: int) -> set[str]:
    """Names of the frames of some steps to come."""
    return {trainer.schedule.frame(step).name for step in range(start, end)}


@pytest.mark.parametrize(("noise", "noisy"), [(NOISE, True), (1e-9, False)])
def test_views_stay_withheld_while_noise_may_be_learnt(tmp_path: Path, noise: float, noisy: bool) -> None:
    """Beyond growth, up to the last removal; where images have no noise to speak of, growth frees them."""
    trainer = noisy_run(tmp_path, watched(spectrum_loss=1e9), noise)
    assert trainer.budget is not None
    withheld = {trainer.frames.frames[index].name for index in trainer.budget.validation}  # type: ignore[attr-defined]
    assert len(withheld) == 2
    advance(trainer, 12)
    assert not trainer.state.growing
    assert bool(withheld & shown(trainer, 12, 100)) == (not noisy)
    advance(trainer, 20)
    assert trainer.state.noise_watch is not None
    assert trainer.state.noise_watch.over
    assert withheld < shown(trainer, 20, 100)


def test_few_views_are_not_withheld_for_long(tmp_path: Path) -> None:
    """Where two are more than a twentieth, growth frees them, noisy or not."""
    trainer = advance(noisy_run(tmp_path, watched(), NOISE, FRAMES - 2), 12)
    assert not trainer.state.growing
    assert trainer.state.noise_watch is not None
    assert trainer.state.noise_watch.noise_share("rgb") >= NOISY
    assert trainer.state.noise_watch.over


def test_a_held_spectrum_frees_the_views(tmp_path: Path, worse: None, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is watched any more; RGB is fitted no further than when it was best, and the user is told."""
    trainer = noisy_run(tmp_path, watched(spectrum_patience=2), NOISE)
    advance(trainer, 12)
    watch = trainer.state.noise_watch
    assert watch is not None
    assert watch.held == ("rgb",)
    assert watch.over
    assert watch.floors["rgb"].min() >= NOISE - 1e-6
    assert watch.floors["rgb"].max() > NOISE + 1e-3
    assert trainer.state.taught == ("rgb",)
    assert "Withheld RGB views were best after step 4 (46.00 dB)." in capsys.readouterr().out


@pytest.mark.parametrize("batch_size", [None, 2])
def test_resumed_run_is_the_same(tmp_path: Path, worse: None, batch_size: int | None) -> None:
    """Cut before a spectrum is held, and after."""
    config = dataclasses.replace(watched(spectrum_patience=4), batch_size=batch_size)
    capture = many_frames(toy_capture(), FRAMES)
    end = 18 if batch_size is None else 9
    whole = advance(noisy_run(tmp_path / "whole", config, NOISE), end)
    for stop in (5, end - 2):
        half = advance(noisy_run(tmp_path / f"half{stop}", config, NOISE), stop)
        half.save()
        resumed = advance(Trainer.resume(config, capture, half.run), end)
        assert_same_state(state_tensors(resumed), state_tensors(whole))
        assert resumed.state.noise_watch is not None
        assert whole.state.noise_watch is not None
        assert resumed.state.noise_watch.held == whole.state.noise_watch.held == ("rgb",)
        assert torch.equal(resumed.state.noise_watch.floors["rgb"], whole.state.noise_watch.floors["rgb"])
