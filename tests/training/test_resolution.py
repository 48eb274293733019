"""Trainings whose images grow: the same loop, resumed, in batches and from the disk; Gaussians grow with the images."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import AutoBudgetConfig, ResolutionConfig, TrainConfig
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.evaluation import held_out
from thermosplat.training import training_step
from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.stages import cameras
from toy_run import (
    assert_same_state,
    enlarged,
    many_frames,
    state_tensors,
    stopped_and_resumed,
    toy_run_config,
    toy_trainer,
)
from toy_scene import toy_capture

pytestmark = pytest.mark.usefixtures("stoppable")

GROWING = ResolutionConfig(factors=(1.5, 1.2), until=(0.34, 0.67), growth_power=2.0)
"""Of twelve steps four at 48x36 pixels, four at 60x45, and four at 72x54."""


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Four training frames and one held out, of 72x54 pixels."""
    return enlarged(many_frames(toy_capture()), 3)


def growing(max_steps: int = 12, **changes: Any) -> TrainConfig:
    return toy_run_config(max_steps, resolution=GROWING, **changes)


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Width and height of every photograph that steps compare with."""
    sizes: list[tuple[int, ...]] = []
    original = training_step.compare_frame

    def noted(rendered: Any, frame: Any, config: TrainConfig) -> Any:
        sizes.append((frame.views["rgb"].width, frame.views["rgb"].height))
        assert rendered.images["rgb"].shape == frame.views["rgb"].image.shape
        return original(rendered, frame, config)

    monkeypatch.setattr(training_step, "compare_frame", noted)
    return sizes


def test_images_grow_and_evaluation_has_full_size(
    tmp_path: Path, capture: Capture, compared: list[tuple[int, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps see three sizes, as the user is told; held-out views, also those evaluated early, have one."""
    evaluated: list[int] = []
    original = held_out.rendered_views

    def noted(*arguments: Any, **named: Any) -> Any:
        for found in original(*arguments, **named):
            evaluated.append(found.image.shape[1])
            yield found

    monkeypatch.setattr(held_out, "rendered_views", noted)
    trainer, said = toy_trainer(tmp_path, growing(eval_steps=(2,)), capture), []
    monkeypatch.setattr(trainer.logger, "say", said.append)
    trainer.train()
    assert compared == [(48, 36)] * 4 + [(60, 45)] * 4 + [(72, 54)] * 4
    assert any("divided by 1.5 up to step 4" in line for line in said)
    assert set(evaluated) == {72}


def test_growth_follows_the_images(tmp_path: Path, capture: Capture) -> None:
    """While images are small, a set grows to as many Gaussians as go with their size, here as many to a pixel."""
    config = growing()
    wanted = dataclasses.replace(config.densification, max_gaussians=150, grad_threshold=0.0)
    trainer = toy_trainer(tmp_path, dataclasses.replace(config, densification=wanted), capture)
    counts = []
    while trainer.step < 12:
        trainer.train_step()
        counts.append(trainer.model.num_gaussians)
    assert max(counts[:4]) <= math.floor(150 / 1.5**2) < max(counts[4:8]) <= math.floor(150 / 1.2**2) < counts[-1]


def test_mcmc_grows_with_the_images_and_is_not_full_before(tmp_path: Path, capture: Capture) -> None:
    """The budget that ends growth is the last one."""
    config = growing()
    mcmc = dataclasses.replace(config.densification, strategy="mcmc", max_gaussians=150, growth=0.55)
    trainer = toy_trainer(tmp_path, dataclasses.replace(config, densification=mcmc), capture)
    (strategy,) = trainer.state.strategies.values()
    (gaussians,) = trainer.state.gaussian_sets.values()
    counts, full = [], []
    while trainer.step < 12:
        trainer.train_step()
        counts.append(len(gaussians))
        full.append(strategy.is_full(gaussians))
    assert (counts[3], counts[6], counts[-1]) == (66, 102, 150)
    assert not any(full[:9])
    assert full[-1]


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"batch_size": 2, "max_steps": 24},
        {"refine": ("poses",), "refine_from": 2},
        {
            "budget": "auto",
            "auto_budget": AutoBudgetConfig(prune_at=(0.5, 0.8)),
        },
    ],
    ids=["plain", "batches", "poses", "budget"],
)
def test_resumed_run_is_the_same_to_the_bit(tmp_path: Path, capture: Capture, changes: dict[str, Any]) -> None:
    """Six steps, a checkpoint among small images, and the others equal all of them at once."""
    config = growing(**{"max_steps": 12, **changes})
    whole = toy_trainer(tmp_path / "whole", config, capture)
    second = stopped_and_resumed(tmp_path / "halves", config, capture, 6)
    whole.train()
    second.train()
    assert_same_state(state_tensors(second), state_tensors(whole))


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("widest", "factors"), [((160, 160), (1.0, 1.0)), ((40, 40), (1.2, 1.2)), ((40, 160), (1.2, 1.0))]
)
def test_cameras_are_found_on_small_images(
    tmp_path: Path,
    compared: list[tuple[int, ...]],
    monkeypatch: pytest.MonkeyPatch,
    widest: tuple[int, int],
    factors: tuple[float, float],
) -> None:
    """No thermal image is wider than its pass allows; the scene that is trained with the cameras begins small."""
    seen: list[tuple[int, int]] = []
    sizes = {1.0: ((72, 54), (48, 42)), 1.2: ((60, 45), (40, 35))}

    def noted(model: Any, corrections: Any, frames: Any, *others: Any) -> None:
        view = frames[0].views["thermal"]
        assert view.image.shape[:2] == (view.height, view.width)
        seen.append((view.width, view.height))

    monkeypatch.setattr(cameras, "WIDEST", widest)
    monkeypatch.setattr(cameras, "register_cameras", noted)
    monkeypatch.setattr("thermosplat.evaluation.held_out_poses.STEPS", 2)
    capture = enlarged(many_frames(toy_capture(aligned=False)), 3)
    config = growing(refine=("rig",), refine_from=1, refine_every=1, refine_first=3)
    toy_trainer(tmp_path, config, capture).train()
    (first, first_thermal), (second, second_thermal) = (sizes[factor] for factor in factors)
    assert compared[:6] == [first] * 3 + [second] * 3
    assert seen == [first_thermal] * 2 + [second_thermal] * 2
    assert compared[6:] == [(48, 36)] * 4 + [(60, 45)] * 4 + [(72, 54)] * 4


def test_noise_floors_are_those_of_averages(tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of k pixels has a k-th of the variance of their noise."""
    seen: list[float] = []
    original = training_step.gradient_shares

    def noted(compared: Any, floors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        seen.append(floors["thermal"].item())
        return original(compared, floors)

    monkeypatch.setattr(training_step, "gradient_shares", noted)
    trainer = toy_trainer(tmp_path, growing(), capture)
    trainer.state.noise_watch = NoiseWatch({"thermal": 0.01}, len(trainer.frames), trainer.device)
    while trainer.step < 12:
        trainer.train_step()
    expected = [0.01 / 2.25] * 4 + [0.01 / 1.44] * 4 + [0.01] * 4
    assert seen == pytest.approx(expected)
    errors = trainer.state.noise_watch.errors["thermal"]  # those of averages are not kept
    assert torch.count_nonzero(errors) == len({trainer.schedule.frame(step).name for step in range(8, 12)})


def test_images_on_the_disk_shrink_to_the_same_pixels(tmp_path: Path) -> None:
    """A capture whose images are read ahead of the steps trains to the same bits."""
    root = load_capture("sample").root
    config = toy_run_config(6, resolution=ResolutionConfig(factors=(2.0, 1.5), until=(0.3, 0.7)))
    in_memory, on_disk = load_capture(root, data_factor=2), load_capture(root, data_factor=2, image_memory=0.002)
    assert on_disk.on_disk is not None
    held, read = toy_trainer(tmp_path / "held", config, in_memory), toy_trainer(tmp_path / "read", config, on_disk)
    try:
        while held.step < 6:
            held.train_step()
            read.train_step()
    finally:
        read.frames.close()
    assert_same_state(state_tensors(held), state_tensors(read))
