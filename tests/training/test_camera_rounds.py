"""Passes that find cameras: as long for every length of a run, and on a scene that covers its images at once."""

from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import LossConfig
from thermosplat.config.files import load_config
from thermosplat.training.stages.cameras import CameraStage
from thermosplat.training.trainer import Trainer
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


@pytest.mark.parametrize("preset", ["thermosplat", "thermosplat_plus", "thermosplat_fast", "demo"])
def test_every_preset_has_rounds_enough(preset: str) -> None:
    """A pass with four rounds left the thermal camera of rig_desk as far off as it was; with sixty it comes back."""
    config = load_config(preset)
    steps = min(config.refine_first, config.max_steps) - config.refine_rounds_from
    assert steps // config.refine_every >= 50


@pytest.mark.parametrize(
    ("max_steps", "scaler", "steps"), [(30000, 1, 600), (7000, 1, 600), (7000, 0.05, 350), (100, 1, 100)]
)
def test_a_pass_is_as_long_for_every_run(tmp_path: Path, max_steps: int, scaler: float, steps: int) -> None:
    """Unless the run itself is shorter."""
    config = toy_run_config(max_steps, steps_scaler=scaler, refine=("rig",), refine_first=600, refine_from=0)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(aligned=False)))
    (cameras,) = (stage for stage in trainer.stages if isinstance(stage, CameraStage))
    assert cameras.steps == steps


def test_cameras_are_found_on_a_scene_without_holes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts as 3DGS does, whatever the method's own start, and no penalty thins it out; the trained scene has both.

    With thermosplat_fast's small first Gaussians the focal length of rig_desk doubled within ten rounds.
    """
    capture = many_frames(toy_capture(aligned=False))
    passes: dict[str, Any] = {"refine": ("rig",), "refine_from": 0, "refine_every": 1, "refine_first": 2}
    usual = toy_trainer(tmp_path / "usual", toy_run_config(4, **passes), capture)
    penalties = LossConfig(opacity_reg=0.01, scale_reg=0.01)
    own_start = {"init_opacity": 0.5}
    trainer = toy_trainer(tmp_path / "own", toy_run_config(4, model=own_start, loss=penalties, **passes), capture)
    terms: list[set[str]] = []
    monkeypatch.setattr(trainer.logger, "step", lambda record: terms.append(set(record.losses)))
    starts = []
    for _ in range(3):
        starts.append([value.detach().clone() for value in start_of(trainer)])
        trainer.train_step()
        trainer.train_step()
    for found_on in starts[:2]:
        torch.testing.assert_close(found_on, start_of(usual))
    torch.testing.assert_close(starts[2][1], torch.zeros_like(starts[2][1]))  # logits of a half
    assert [("opacity_reg" in found, "scale_reg" in found) for found in terms] == [(False, False)] * 4 + [
        (True, True)
    ] * 2


def start_of(trainer: Trainer) -> list[torch.Tensor]:
    """Scales and opacities of a trainer's Gaussians, as they are stored."""
    gaussians = trainer.model.gaussians("shared")
    return [gaussians.log_scales.detach(), gaussians.logit_opacities.detach()]
