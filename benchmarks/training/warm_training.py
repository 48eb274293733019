"""The first part of a training run, densification included: a model to measure on, and what a refinement costs."""

import statistics
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from thermosplat.config import TrainConfig
from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets.capture import Capture
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.training.trainer import Trainer
from training.frozen_training import Frames, quiet_trainer, run_steps

STRETCH = 3
"""Steps timed together: the refining one, and those after it, which record the step anew."""


def warm_training(
    config: TrainConfig, capture: Capture, steps: int, frames: Frames
) -> tuple[Checkpoint, dict[str, Any] | None]:
    """Trains so many steps.

    Args:
        config: The whole configuration.
        capture: The capture.
        steps: How many.
        frames: As in ``quiet_trainer``.

    Returns:
        The state, as ``TrainingState.checkpoint`` has it. And of densification ``refinement_ms``, what a refinement
        adds to the steps around it (median), how many were timed, ``every`` how many steps there is one, and that
        share of it, ``ms_a_step``; None if there was none with steps beside it to compare with.
    """
    config = replace(in_steps(config), max_steps=max(config.max_steps, steps))
    every = config.densification.every
    refining: list[float] = []
    usual: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        trainer = quiet_trainer(config, capture, Path(folder) / "run", frames=frames)
        while trainer.step < steps:
            timed = None
            if trainer.step + STRETCH <= steps:
                if _refines(trainer, trainer.step + 1):
                    timed = refining
                elif refining and (trainer.step - every // 2) % every == 0:
                    timed = usual
            seconds = run_steps(trainer, STRETCH if timed is not None else 1, waiting=timed is not None)
            if timed is not None:
                timed.append(1e3 * seconds)
        state = trainer.state.checkpoint(config, trainer.sh_degree, capture.scales)
    if not refining or not usual:
        return state, None
    cost = statistics.median(refining) - statistics.median(usual)
    return state, {"refinement_ms": cost, "timed": len(refining), "every": every, "ms_a_step": cost / every}


def _refines(trainer: Trainer, step: int) -> bool:
    return any(strategy.refines_at(step) for strategy in trainer.state.strategies.values())
