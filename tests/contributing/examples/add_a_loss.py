"""A loss on edges."""

from pathlib import Path

import pytest
import torch

from thermosplat.losses.image_terms import compare_frame, edges
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import render, toy_capture, toy_frame


def test_a_step_that_is_missing_counts_once_in_its_direction() -> None:
    """A render without a step of 0.5 across: the mean over differences across, nothing down."""
    target = torch.zeros(4, 3, 1)
    target[:, 2] = 0.5
    assert edges(torch.zeros(4, 3, 1), target).item() == pytest.approx(0.25)


def test_steps_have_it(tmp_path: Path) -> None:
    """Two steps train with it, and its term is listed."""
    config = toy_run_config(2, spectra={"thermal": {"edges": 0.5}})
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    trainer.train()
    frame = toy_frame(toy_capture())
    losses = compare_frame(render(trainer.model, frame), frame, config).losses
    assert losses["thermal_edges"].item() > 0
