"""Noisy spectra are held where withheld views were best."""

import copy
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.training.budget.noise_watch import NOISY, SOON_NOISY, NoiseWatch
from thermosplat.training.budget.teacher import Teacher
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, tolerating, toy_run_config, toy_trainer
from toy_scene import toy_capture, toy_config, toy_model

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
    watch.errors["rgb"].fill_(0.001)
    assert watch.judge(900, {"rgb": 1.0}, LOSS, PATIENCE) == []
    assert watch.floors["rgb"].tolist() == pytest.approx([0.02, 0.014, 0.015, 0.01])


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


@pytest.mark.parametrize(("last", "goes_back"), [(19.95, True), (19.96, False), (20.1, False)])
def test_a_held_spectrum_goes_back_to_its_best(last: float, goes_back: bool) -> None:
    """At the end of the watch, if withheld views still miss it: to the best step of all, before or after the fall."""
    watch = watch_with([0.02, 0.02])
    model = toy_model(toy_config(), toy_capture())
    scenes = iter([Teacher.of_now(model, degree) for degree in range(3)])
    for step, psnr in ((100, 19.0), (200, 18.9), (300, 20.0), (400, last)):
        watch.judge(step, {"rgb": psnr}, LOSS, PATIENCE, lambda: next(scenes))
    assert watch.held == ("rgb",)
    assert watch.end(LOSS) == (["rgb"] if goes_back else [])
    assert watch.over
    assert {name: teacher.sh_degree for name, teacher in watch.teachers.items()} == ({"rgb": 1} if goes_back else {})


FALL = 0.3


@pytest.mark.parametrize(
    ("looks", "goes_back"),
    [
        ([19.5, 19.69, 19.6], True),
        ([19.8, 19.6, 19.6], True),  # longer ago than patience
        ([19.5, 19.71, 19.5], False),  # not all of the time
        ([19.5, 19.5, 20.1], False),  # better
    ],
)
def test_where_views_are_few_a_spectrum_that_fell_far_goes_back(looks: list[float], goes_back: bool) -> None:
    """Whatever its noise, by the looks of the last 100 steps."""
    watch, teacher = watch_with([1.0, 1.0]), Teacher.of_now(toy_model(toy_config(), toy_capture()), 0)
    for step, psnr in zip((100, 200, 280, 320), (20.0, *looks), strict=True):
        watch.judge(step, {"rgb": psnr}, LOSS, PATIENCE, lambda: teacher, noisy_only=False)
    assert watch.held == ()
    other = NoiseWatch(watch.noise, 2, torch.device("cpu"))  # as a run that is resumed
    other.load_state_dict(copy.deepcopy(watch.state_dict()))
    assert other.lately == watch.lately
    assert watch.end(LOSS, FALL) == (["rgb"] if goes_back else [])
    assert list(watch.teachers) == (["rgb"] if goes_back else [])


def test_only_held_spectra_go_back() -> None:
    """A fall that was not one of patience long, or not of noise, sends none back."""
    watch, teacher = watch_with([0.02, 0.02]), Teacher.of_now(toy_model(toy_config(), toy_capture()), 0)
    watch.judge(100, {"rgb": 20.0}, LOSS, PATIENCE, lambda: teacher)
    watch.judge(150, {"rgb": 19.0}, LOSS, PATIENCE, lambda: teacher)
    assert watch.end(LOSS) == []
    assert watch.teachers == {}


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


def test_floors_follow_the_noise() -> None:
    """A run that goes on with other images is fitted up to their noise, as before where they are the same."""
    watch = watch_with([0.02, 0.02])
    watch.floors["rgb"].copy_(torch.tensor([0.01, 0.03]))
    watch.measured_anew({"rgb": 0.01, "thermal": 1.0})
    assert watch.floors["rgb"].tolist() == pytest.approx([0.01, 0.03])
    watch.measured_anew({"rgb": 0.0025})
    assert watch.noise == {"rgb": 0.0025}
    assert watch.floors["rgb"].tolist() == pytest.approx([0.0025, 0.0075])


@pytest.fixture(autouse=True)
def _growth_ends_at_once() -> Iterator[None]:
    """And no spectrum is held or sent back, but where a test says after how many looks."""
    with tolerating(growth_looks=1):
        yield


@pytest.fixture
def worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Withheld views lose a decibel of RGB in every step."""
    judge = NoiseWatch.judge

    def judged(watch: NoiseWatch, step: int, psnrs: dict[str, float], *others: Any, **named: Any) -> list[str]:
        return judge(watch, step, psnrs | {"rgb": 50.0 - step}, *others, **named)

    monkeypatch.setattr(NoiseWatch, "judge", judged)


def watched() -> TrainConfig:
    """A short run that withholds two frames, and whose growth ends at once."""
    return toy_run_config(100, budget="auto", auto_budget=AutoBudgetConfig(prune_at=(0.2,), validate_every=2))


def noisy_run(folder: Path, config: TrainConfig, noise: float, frames: int = FRAMES) -> Trainer:
    """With that variance of noise in RGB, whatever its images have, which do not count as noisy."""
    trainer = toy_trainer(folder, config, many_frames(toy_capture(), frames))
    trainer.budget.noisy = False  # type: ignore[union-attr]
    trainer.state.noise_watch = NoiseWatch({"rgb": noise}, len(trainer.frames), trainer.device)
    return trainer


def advance(trainer: Trainer, steps: int) -> Trainer:
    """The trainer, so many steps from its start."""
    while trainer.step < steps:
        trainer.train_step()
    return trainer


def shown(trainer: Trainer, start: int, end: int) -> set[str]:
    """Names of the frames of some steps to come."""
    return {trainer.schedule.frame(step).name for step in range(start, end)}


@pytest.mark.rotating
@pytest.mark.parametrize(("noise", "noisy"), [(NOISE, True), (1e-9, False)])
def test_views_stay_withheld_while_noise_may_be_learnt(tmp_path: Path, noise: float, noisy: bool) -> None:
    """Beyond growth, up to the last removal; where images have no noise to speak of, growth frees them."""
    with tolerating(spectrum_loss=1e9):
        trainer = noisy_run(tmp_path, watched(), noise)
    assert trainer.budget is not None
    withheld = {trainer.frames.frames[index].name for index in trainer.budget.validation}  # type: ignore[attr-defined]
    assert len(withheld) == 2
    advance(trainer, 12)
    assert not trainer.state.budget.growing
    assert bool(withheld & shown(trainer, 12, 100)) == (not noisy)
    advance(trainer, 20)
    assert trainer.state.noise_watch is not None
    assert trainer.state.noise_watch.over
    assert withheld < shown(trainer, 20, 100)


@tolerating(few_views_until=0.16)
def test_few_views_stay_withheld_for_a_share_of_the_run(tmp_path: Path) -> None:
    """Where two are more than a twentieth: up to that share of the run, whatever part of the error is noise."""
    for noise in (NOISE, 1e-9):
        trainer = advance(noisy_run(tmp_path / f"{noise}", watched(), noise, FRAMES - 2), 12)
        assert not trainer.state.budget.growing
        assert trainer.state.noise_watch is not None
        assert not trainer.state.noise_watch.over
        advance(trainer, 16)
        assert trainer.state.noise_watch.over


@tolerating(spectrum_looks=1)
def test_few_noisy_views_stay_withheld_up_to_the_last_removal(
    tmp_path: Path, worse: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """As many do, where images count as noisy: only they say when noise is learnt. RGB falls and goes back."""
    trainer = noisy_run(tmp_path, watched(), NOISE, FRAMES - 2)
    trainer.budget.noisy = True  # type: ignore[union-attr]
    advance(trainer, 19)
    watch = trainer.state.noise_watch
    assert watch is not None
    assert not trainer.state.budget.growing
    assert not watch.over
    advance(trainer, 20)
    assert watch.over
    assert trainer.state.taught == ("rgb",)
    assert "Withheld RGB views were best after step" in capsys.readouterr().out


@tolerating(few_views_until=0.12, fallen_views_until=0.16, spectrum_looks=2)
def test_few_views_say_what_goes_back(tmp_path: Path, worse: None, capsys: pytest.CaptureFixture[str]) -> None:
    """RGB falls by a decibel in each step, and has no noise."""
    config = watched()
    trainer = advance(noisy_run(tmp_path, config, 1e-9, FRAMES - 2), 15)
    assert not trainer.state.budget.growing
    assert trainer.state.taught == ()
    assert trainer.budget is not None
    withheld = {trainer.frames.frames[index].name for index in trainer.budget.validation}  # type: ignore[attr-defined]
    assert not withheld & shown(trainer, 15, 100)
    advance(trainer, 16)
    assert trainer.state.taught == ("rgb",)
    assert "Withheld RGB views were best after step 4: 46.00 dB, and now 34.00." in capsys.readouterr().out
    assert withheld < shown(trainer, 16, 100)


@pytest.mark.parametrize(("again", "released"), [(14, 14), (16, 16)])
@tolerating(few_views_until=0.12, fallen_views_until=0.16, spectrum_looks=2)
def test_few_views_that_fell_for_a_while_send_nothing_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: int, released: int
) -> None:
    """RGB is a decibel below its best from step 6 on, and then as good again: its views are free once that is seen."""
    judge = NoiseWatch.judge

    def judged(watch: NoiseWatch, step: int, psnrs: dict[str, float], *others: Any, **named: Any) -> list[str]:
        return judge(watch, step, psnrs | {"rgb": 49.0 if 6 <= step < again else 50.0}, *others, **named)

    monkeypatch.setattr(NoiseWatch, "judge", judged)
    config = watched()
    trainer = advance(noisy_run(tmp_path, config, 1e-9, FRAMES - 2), released - 1)
    watch = trainer.state.noise_watch
    assert watch is not None
    assert watch.fallen(0.3) == ["rgb"]
    assert not watch.over
    advance(trainer, released)
    assert watch.over
    assert trainer.state.taught == ()


@tolerating(spectrum_looks=1)
def test_a_held_spectrum_goes_back_at_the_last_removal(
    tmp_path: Path, worse: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Until then RGB is fitted no further than when it was best; then the scene of then teaches it, as the user is
    told, and nothing is withheld any more."""
    trainer = noisy_run(tmp_path, watched(), NOISE)
    advance(trainer, 19)
    watch = trainer.state.noise_watch
    assert watch is not None
    assert (watch.held, watch.over, trainer.state.taught) == (("rgb",), False, ())
    assert watch.floors["rgb"].min() >= NOISE - 1e-6
    assert watch.floors["rgb"].max() > NOISE + 1e-3
    advance(trainer, 20)
    assert (watch.over, trainer.state.taught) == (True, ("rgb",))
    assert "Withheld RGB views were best after step 4: 46.00 dB, and now 30.00." in capsys.readouterr().out
    assert trainer.budget is not None
    withheld = {trainer.frames.frames[index].name for index in trainer.budget.validation}  # type: ignore[attr-defined]
    assert withheld < shown(trainer, 20, 100)


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("batch_size", [None, 2])
@tolerating(spectrum_looks=2)
def test_resumed_run_is_the_same(
    tmp_path: Path, worse: None, monkeypatch: pytest.MonkeyPatch, batch_size: int | None
) -> None:
    """Cut before a spectrum is held, after that, and when it has gone back to its best."""
    monkeypatch.setattr("thermosplat.training.recipe.noise_floors", lambda *of: ({"rgb": NOISE}, ()))
    config = dataclasses.replace(watched(), batch_size=batch_size)
    capture = many_frames(toy_capture(), FRAMES)
    end = 24 if batch_size is None else 12
    whole = advance(noisy_run(tmp_path / "whole", config, NOISE), end)
    for stop in (5, end - 6, end - 2):
        half = advance(noisy_run(tmp_path / f"half{stop}", config, NOISE), stop)
        half.save()
        resumed = advance(Trainer.resume(config, capture, half.run), end)
        assert_same_state(state_tensors(resumed), state_tensors(whole))
        assert resumed.state.noise_watch is not None
        assert whole.state.noise_watch is not None
        assert resumed.state.noise_watch.held == whole.state.noise_watch.held == ("rgb",)
        assert resumed.state.taught == whole.state.taught == ("rgb",)
        assert torch.equal(resumed.state.noise_watch.floors["rgb"], whole.state.noise_watch.floors["rgb"])
