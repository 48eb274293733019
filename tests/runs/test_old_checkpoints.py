"""Checkpoints of version 0.1 are read, rendered and trained further."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.trainer import Trainer
from toy_run import many_frames
from toy_scene import toy_capture

FOLDER = Path(__file__).resolve().parents[1] / "fixtures" / "version_0_1"
KINDS = {"shared": "color", "separate": "scalar", "thermal_alone": "scalar"}
"""Runs of the toy capture by version 0.1 (commit fcaeaed), six steps; what its thermal images are."""


@pytest.mark.parametrize("name", KINDS)
def test_the_same_images(name: str) -> None:
    """The model of the file renders what version 0.1 rendered of it."""
    capture = many_frames(toy_capture(thermal_kind=KINDS[name]))
    checkpoint = load_checkpoint(FOLDER / f"{name}.pt")
    scales = {spectrum: PixelScale.from_state_dict(scale) for spectrum, scale in checkpoint.scales.items()}
    assert scales == capture.scales
    frame = frame_tensors(capture.test[0], scales, "cpu")
    model = SceneModel.from_checkpoint(checkpoint, "cpu")
    with torch.no_grad():
        rendered = model.render(frame.views, sh_degree=checkpoint.sh_degree)
    expected = np.load(FOLDER / f"{name}_images.npz")
    assert set(expected.files) == set(rendered.images)
    for spectrum, image in rendered.images.items():
        np.testing.assert_allclose(image.numpy(), expected[spectrum], rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", KINDS)
def test_training_goes_on(name: str, tmp_path: Path) -> None:
    """Optimizers, density control and exposures come along."""
    capture = many_frames(toy_capture(thermal_kind=KINDS[name]))
    run = RunDirectory.create(tmp_path / "run")
    run.checkpoint(6).parent.mkdir(parents=True, exist_ok=True)
    run.checkpoint(6).write_bytes((FOLDER / f"{name}.pt").read_bytes())
    checkpoint = load_checkpoint(run.checkpoint(6))
    densification = dataclasses.replace(checkpoint.config.densification, reset_every=50)  # until then none is too large
    config = dataclasses.replace(checkpoint.config, max_steps=8, device="cpu", densification=densification)
    trainer = Trainer.resume(config, capture, run)
    moments = trainer.state.optimizers[next(iter(trainer.state.gaussian_sets))]["means"].state_dict()["state"]
    assert moments[0]["exp_avg"].abs().max() > 0
    trainer.train()
    assert trainer.step == 8
