"""Every baseline preset trains: both spectra get closer to their images, through checkpoints and all."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config, preset_paths
from thermosplat.datasets.capture import Capture
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.thermal.radiometry import FLIR_IRON
from thermosplat.training.density import decomposition
from thermosplat.training.trainer import Trainer
from toy_scene import HEIGHT, WIDTH, toy_capture

BASELINES = [name for name, path in preset_paths().items() if path.parent.name == "baselines"]


def short(name: str, steps: int) -> TrainConfig:
    """A preset on a schedule that fits into so many steps, for each spectrum."""
    config = load_config(name)
    densification = dataclasses.replace(
        config.densification,
        start_step=4,
        stop_step=steps,
        every=7,
        reset_every=1000,
        max_gaussians=300,
        prune_opacity=0.005,
    )
    return dataclasses.replace(
        config,
        max_steps=steps * (2 if config.spectra["thermal"].train_from == 0.5 else 1),
        sh_degree=min(config.sh_degree, 1),
        sh_degree_interval=10,
        device="cpu",
        eval_steps=(),
        save_steps=(),
        tensorboard=False,
        densification=densification,
    )


@pytest.fixture(autouse=True)
def _kept_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """These few steps raise no opacity above MMOne's 0.5."""
    monkeypatch.setattr(decomposition, "KEEP_OPACITY", 0.05)


@pytest.fixture(scope="module")
def capture() -> Capture:
    """One frame of gradients, which is also the held-out one: whether a method learns, not whether it generalises."""
    capture = toy_capture()
    (frame,) = capture.train
    x = np.linspace(0.0, 1.0, WIDTH, dtype=np.float32).repeat(HEIGHT).reshape(WIDTH, HEIGHT).T
    rgb = np.stack([x, 1.0 - x, np.full_like(x, 0.7)], axis=-1)
    images = {"rgb": rgb, "thermal": FLIR_IRON.to_color(x)}
    views = {
        name: dataclasses.replace(frame.views[name], image=np.rint(255 * image).astype(np.uint8))
        for name, image in images.items()
    }
    frames = (dataclasses.replace(frame, views=views),)
    return dataclasses.replace(capture, train=frames, test=frames)


@pytest.mark.rotating
@pytest.mark.parametrize("name", BASELINES)
def test_baseline_learns(name: str, tmp_path: Path, capture: Capture) -> None:
    """Thirty steps of each spectrum improve both images, with Gaussians added on the way."""
    trainer = Trainer(short(name, 30), capture, RunDirectory.create(tmp_path))
    count = trainer.model.num_gaussians
    before = trainer.results.evaluate().metrics
    after = trainer.train()
    assert after["rgb"]["psnr"] > before["rgb"]["psnr"] + 1.0
    assert after["thermal"]["psnr"] > before["thermal"]["psnr"] + 1.0
    assert after["num_gaussians"] != count
    assert sorted(path.name for path in (tmp_path / "ply").iterdir()) == ["splat_rgb.ply", "splat_thermal.ply"]


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("name", BASELINES)
def test_baseline_goes_on_from_a_checkpoint(name: str, tmp_path: Path, capture: Capture) -> None:
    """Stopped in the middle, a baseline ends where it would have ended undisturbed."""
    config = short(name, 12)
    whole = Trainer(config, capture, RunDirectory.create(tmp_path / "whole"))
    whole.train()
    half = Trainer(config, capture, RunDirectory.create(tmp_path / "half"))
    while half.step < config.max_steps // 2 + 1:
        half.train_step()
    half.save()
    resumed = Trainer.resume(config, capture, RunDirectory.open(tmp_path / "half"))
    resumed.train()
    expected, restored = whole.model.state_dict(), resumed.model.state_dict()
    assert expected.keys() == restored.keys()
    assert all(torch.equal(expected[key], restored[key]) for key in expected)


def test_mftg_renders_rgb_from_the_gaussians_before_fine_tuning(tmp_path: Path, capture: Capture) -> None:
    """The thermal set starts as a copy of the RGB set; from then on RGB stays as it is."""
    trainer = Trainer(short("thermalgaussian_mftg", 8), capture, RunDirectory.create(tmp_path))
    start = trainer.model.gaussians("thermal").sh0.detach().clone()
    while trainer.step < 8:
        trainer.train_step()
    rgb, thermal = (dict(trainer.model.gaussians(name).named_parameters()) for name in ("rgb", "thermal"))
    assert thermal["sh0"].shape != start.shape or not torch.equal(thermal["sh0"], start)
    assert all(torch.equal(rgb[name], thermal[name]) for name in rgb)
    assert len(trainer.state.strategies["thermal"].grad_norm_sum) == len(trainer.model.gaussians("thermal"))
    kept = {name: value.detach().clone() for name, value in rgb.items()}
    while trainer.step < 16:
        trainer.train_step()
    rgb, thermal = (dict(trainer.model.gaussians(name).named_parameters()) for name in ("rgb", "thermal"))
    assert all(torch.equal(rgb[name], kept[name]) for name in kept)
    assert thermal["sh0"].shape != kept["sh0"].shape or not torch.equal(thermal["sh0"], kept["sh0"])
