"""What the host decides about a step."""

import dataclasses
import json
from pathlib import Path

import torch
from toy_run import many_frames, toy_run_config, toy_trainer

from thermosplat.config import DensificationConfig, LossConfig, ScheduleConfig
from thermosplat.training.training_step import StepKind, sh_degree_at
from toy_scene import toy_capture


def test_sh_degree_rises_with_the_steps() -> None:
    """One more degree every interval, up to the configured one: as gsplat, from the step after the interval on."""
    config = toy_run_config()  # interval 4, degree 1
    assert [sh_degree_at(config, step) for step in (0, 1, 4, 5, 8, 9, 12)] == [0, 0, 0, 1, 1, 1, 1]


def test_depths_are_drawn_together_late(tmp_path: Path) -> None:
    """From its share of the steps on the spread of depths is a loss, and only then."""
    config = toy_run_config(max_steps=8, log_every=1)
    loss = dataclasses.replace(config.loss, depth_spread=0.1, depth_spread_from=0.75)
    config = dataclasses.replace(config, loss=loss)
    assert [StepKind.at(config, step, densifying=False).depth_spread for step in (1, 6, 7, 8)] == [0, 0, 1, 1]
    assert not StepKind.at(toy_run_config(), 12, densifying=False).depth_spread
    toy_trainer(tmp_path, config, many_frames(toy_capture())).train()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "depth_spread" in line] == [7, 8]


def test_penalties_leave_alone_what_a_step_does_not_train(tmp_path: Path) -> None:
    """RGB Gaussians that are kept while thermal ones are fine-tuned, and thermal ones before, do not fade or shrink."""
    model = {"gaussian_sets": "separate", "feature_dim": 0, "geometric_decoupling": False}
    config = toy_run_config(
        8,
        model=model,
        schedule=ScheduleConfig(rgb_until=0.5, thermal_from=0.5),
        loss=LossConfig(opacity_reg=0.01, scale_reg=0.01),
        densification=DensificationConfig(enabled=False),
    )
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    for kept, steps in (("thermal", 4), ("rgb", 8)):
        before = {name: value.clone() for name, value in trainer.model.gaussians(kept).state_dict().items()}
        while trainer.step < steps:
            trainer._train_step()
        after = trainer.model.gaussians(kept).state_dict()
        assert all(torch.equal(value, after[name]) for name, value in before.items())
