"""The loop trains, writes its results, and goes on exactly where it stopped."""

import csv
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import DensificationConfig, LossConfig, OptimizerConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer
from toy_run import (
    assert_same_state,
    many_frames,
    state_tensors,
    stopped_and_resumed,
    toy_run_config,
    toy_trainer,
    without,
)
from toy_scene import toy_capture

pytestmark = pytest.mark.usefixtures("stoppable")

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}
NIR = {"others": ("nir",)}
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "shared": ({}, {}),
    "shared, two cameras": ({}, {"aligned": False}),
    "separate, scalar thermal": ({"model": SEPARATE}, {"thermal_kind": "scalar"}),
    "three spectra, two opacities": ({"spectra": {"nir": {}}}, NIR),
    "three spectra, three opacities, two cameras": (
        {"spectra": {"nir": {"opacity": "own", "modulated_by": "thermal", "train_from": 0.3}}},
        {"aligned": False} | NIR,
    ),
    "three spectra, spherical harmonics": (
        {"model": {"feature_dim": 0}, "spectra": {"nir": {"opacity": "offset"}}},
        NIR,
    ),
    "three spectra, separate": ({"model": SEPARATE, "spectra": {"nir": {"train_until": 0.7}}}, NIR),
}


@pytest.fixture(params=KINDS)
def task(request: pytest.FixtureRequest) -> tuple[TrainConfig, Capture]:
    """Every kind of model and capture that trains differently."""
    config, capture = KINDS[request.param]
    return toy_run_config(**config), many_frames(toy_capture(**capture))


@pytest.fixture(scope="module")
def capture() -> Capture:
    """The toy capture with four training frames and one held out."""
    return many_frames(toy_capture())


@pytest.mark.rotating("resumed runs")
def test_resumed_run_is_the_same_to_the_bit(tmp_path: Path, task: tuple[TrainConfig, Capture]) -> None:
    """Twelve steps equal six, a checkpoint, and six more, with Gaussians added, removed and reset in both halves."""
    config, capture = task
    whole = toy_trainer(tmp_path / "whole", config, capture)
    counts = [whole.model.num_gaussians]
    while whole.step < 12:
        whole.train_step()
        counts.append(whole.model.num_gaussians)
    assert len(set(counts[:7])) > 1
    assert len(set(counts[6:])) > 1

    first = toy_trainer(tmp_path / "halves", config, capture)
    while first.step < 6:
        first.train_step()
    first.save()
    second = Trainer.resume(config, capture, RunDirectory.open(tmp_path / "halves"))
    assert second.step == 6
    assert_same_state(state_tensors(second), state_tensors(first))
    second.train()
    assert_same_state(state_tensors(second), state_tensors(whole))


def test_a_scaled_run_is_the_short_one_to_the_bit(tmp_path: Path, capture: Capture) -> None:
    """Twice all numbers of steps, and half of them by the scaler, also where it is resumed."""
    short = toy_run_config()
    grown = {
        name: 2 * getattr(short.densification, name) for name in ("start_step", "stop_step", "every", "reset_every")
    }
    scaled = dataclasses.replace(
        short,
        steps_scaler=0.5,
        max_steps=2 * short.max_steps,
        sh_degree_interval=2 * short.sh_degree_interval,
        eval_steps=tuple(2 * step for step in short.eval_steps),
        save_steps=tuple(2 * step for step in short.save_steps),
        densification=dataclasses.replace(short.densification, **grown),
    )
    expected = toy_trainer(tmp_path / "short", short, capture)
    second = stopped_and_resumed(tmp_path / "scaled", scaled, capture, 6)
    for trainer in (expected, second):
        trainer.train()
    assert second.step == short.max_steps
    assert_same_state(state_tensors(second), state_tensors(expected))


def test_more_views_train_longer(tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run has steps by its views, says so, and stays with them where it is resumed."""
    views = len(capture.train)
    config = toy_run_config(max_steps=3, steps_for_views=views - 1)
    steps = math.ceil(3 * views / (views - 1))
    trainer = toy_trainer(tmp_path, config, capture)
    said: list[str] = []
    monkeypatch.setattr(trainer.logger, "say", said.append)
    assert trainer.train()["steps"] == steps > 3
    (note,) = (line for line in said if "training views, more than" in line)
    assert note.startswith(f"{views} training views, more than {views - 1}: ")
    assert Trainer.resume(config, capture, RunDirectory.open(tmp_path)).config.max_steps == steps


def test_results_of_a_run(tmp_path: Path, capture: Capture) -> None:
    """A run leaves the numbers, pictures, files and checkpoints that the README promises."""
    config = toy_run_config(max_steps=7, save_steps=(3, 7), eval_steps=(4, 7))
    metrics = toy_trainer(tmp_path, config, capture).train()
    run = RunDirectory.open(tmp_path)
    written = json.loads(run.metrics_json.read_text())
    assert written == metrics
    assert list(written)[:7] == ["rgb", "thermal", "spectra", "num_gaussians", "steps", "train_seconds", "device"]
    assert written["spectra"] == ["rgb", "thermal"]
    assert list(written["rgb"]) == ["psnr", "ssim", "lpips"]
    assert set(written["thermal"]) == {"psnr", "ssim", "lpips", "mae_celsius", "bias_celsius"}
    assert written["thermal"]["mae_celsius"] > 0
    assert written["steps"] == 7
    assert 0 < written["train_seconds"] < written["wall_seconds"]
    assert sum(written["gaussians"].values()) == written["num_gaussians"]
    assert sorted(path.name for path in run.ckpts.iterdir()) == ["step_000003.pt", "step_000007.pt"]
    assert sorted(path.name for path in run.ply.iterdir()) == ["splat_rgb.ply", "splat_thermal.ply"]
    assert [path.name for path in run.renders.iterdir()] == ["frame0.png"]
    with (run.stats / "per_view.csv").open() as file:
        assert [(row["frame"], row["spectrum"]) for row in csv.DictReader(file)] == [
            ("frame0", "rgb"),
            ("frame0", "thermal"),
        ]
    lines = [json.loads(line) for line in run.metrics_jsonl.read_text().splitlines()]
    assert [line["step"] for line in lines if "evaluation" in line] == [4, 7]
    assert [line["step"] for line in lines if "loss" in line] == [5, 7]
    assert json.loads((run.stats / "step_000007.json").read_text())["rgb"] == written["rgb"]
    assert run.config_yaml.is_file()
    assert run.environment_json.is_file()


def test_training_learns(tmp_path: Path, capture: Capture) -> None:
    """Both spectra of the frames trained on get closer to their images."""
    config = toy_run_config(
        max_steps=60,
        densification=DensificationConfig(stop_step=0),
        optimizer=OptimizerConfig(decoders_lr=1e-2, decoders_lr_final=1e-2),
    )
    capture = dataclasses.replace(capture, train=capture.train[:1], test=capture.train[:1])
    trainer = toy_trainer(tmp_path, config, capture)
    before = trainer.results.evaluate().metrics
    after = trainer.train()
    assert after["rgb"]["psnr"] > before["rgb"]["psnr"] + 1.0
    assert after["thermal"]["psnr"] > before["thermal"]["psnr"] + 0.5


def test_finished_run_can_be_judged_again(tmp_path: Path, capture: Capture) -> None:
    """Resuming a run that has done its steps evaluates it again and changes nothing."""
    config = toy_run_config(max_steps=4)
    first = toy_trainer(tmp_path, config, capture).train()
    again = Trainer.resume(config, capture, RunDirectory.open(tmp_path)).train()
    for key in ("rgb", "thermal", "num_gaussians", "steps", "train_seconds", "device"):
        assert again[key] == first[key]


def test_no_loss_is_an_error(tmp_path: Path, capture: Capture) -> None:
    """With all weights at zero there is nothing to learn, and the message says so."""
    weightless = {"rgb": {"loss": 0.0}, "thermal": {"loss": 0.0, "smoothness": 0.0}}
    config = toy_run_config(spectra=weightless, loss=LossConfig(features=0.0))
    with pytest.raises(UserError, match="All loss weights are 0") as caught:
        toy_trainer(tmp_path, config, capture).train()
    assert caught.value.hint == "Set the loss of a spectrum, such as --rgb.loss 1."


def test_steps_follow_the_views_that_are_trained_on(tmp_path: Path, capture: Capture) -> None:
    """Frames of a spectrum that is left out ask for no steps."""
    frames = tuple(without(frame, name) for frame in many_frames(capture, 13).train for name in ("rgb", "thermal"))
    config = toy_run_config(20, steps_for_views=12, without=("thermal",))
    trainer = toy_trainer(tmp_path, config, dataclasses.replace(capture, train=frames))
    assert (len(trainer.frames), trainer.config.max_steps) == (12, 20)


def test_frames_of_one_spectrum_train_what_they_show(tmp_path: Path, capture: Capture) -> None:
    """A frame without a thermal image trains the rest; both kinds of frames in one run."""
    frames = tuple(without(frame, "thermal") if index % 2 else frame for index, frame in enumerate(capture.train))
    metrics = toy_trainer(tmp_path, toy_run_config(), dataclasses.replace(capture, train=frames)).train()
    assert metrics["steps"] == 12
    assert metrics["thermal"]["psnr"] > 0


@pytest.mark.cuda
def test_cuda_run_goes_on_on_the_cpu(tmp_path: Path, capture: Capture) -> None:
    """A checkpoint of a GPU is read on a machine without one, and training goes on from it."""
    first = toy_trainer(tmp_path, toy_run_config(max_steps=7, device="cuda"), capture)
    assert first.train()["device"] == torch.cuda.get_device_name()
    resumed = Trainer.resume(toy_run_config(device="cpu"), capture, RunDirectory.open(tmp_path))
    on_gpu = {name: tensor.cpu() for name, tensor in state_tensors(first).items()}
    assert_same_state(state_tensors(resumed), on_gpu)
    assert resumed.train()["steps"] == 12


@pytest.mark.parametrize(("config", "recommended"), [("thermosplat", True), ("demo", False)])
def test_the_demo_is_not_recommended_to_itself(
    tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch, config: str, recommended: bool
) -> None:
    """On the CPU a run hears of the demo preset, unless it is one."""
    trainer = toy_trainer(tmp_path, toy_run_config(1, config=config), capture)
    said: list[str] = []
    monkeypatch.setattr(trainer.logger, "say", said.append)
    trainer.train()
    assert any("training on the CPU" in line or "Training on the CPU" in line for line in said)
    assert any("--config demo" in line for line in said) is recommended


def test_degree_4_trains_and_is_saved(tmp_path: Path) -> None:
    """Its coefficients exist from the start, move once the degree is in use, and are in the checkpoint."""
    config = toy_run_config(6, sh_degree=4, sh_degree_interval=1)
    trainer = toy_trainer(tmp_path / "run", config, many_frames(toy_capture()))
    trainer.train()
    (higher,) = [value for name, value in trainer.model.named_parameters() if name.endswith("shN")]
    assert higher.shape[1:] == (24, 3)
    assert higher[:, 15:].abs().sum() > 0
    saved = load_checkpoint(trainer.run.latest_checkpoint())
    assert saved.sh_degree == 4
