"""Trainers whose steps repeat the same work, so that steps can be timed, compared and profiled.

All learning rates are 0, no Gaussian comes or goes, and all degrees of the spherical harmonics are in use: a step
reads, computes and writes what a step of a run does, and the next one finds the same Gaussians.
"""

import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from thermosplat.config import OptimizerConfig, ScheduleConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.gaussians import Gaussians
from thermosplat.run_directory import RunDirectory
from thermosplat.training.gaussian_ops import become_copy
from thermosplat.training.run_logger import RunLogger
from thermosplat.training.trainer import Trainer

NEVER = 10**8
"""Steps that no measurement gets to."""


def steady_config(config: TrainConfig, *, densifying: bool) -> TrainConfig:
    """A configuration under which steps repeat the same work.

    Args:
        config: The whole configuration.
        densifying: Whether gradients are noted for a refinement that never comes, as in the first half of a run, or
            not, as in the second half.
    """
    rates = {field.name: 0.0 for field in fields(OptimizerConfig) if field.name.endswith("_lr")}
    times = {"start_step": NEVER, "stop_step": NEVER, "reset_every": NEVER}
    return replace(
        config,
        max_steps=2 * NEVER,
        eval_steps=(),
        save_steps=(),
        tensorboard=False,
        sh_degree_interval=1,
        budget="fixed",
        schedule=ScheduleConfig(),
        optimizer=replace(config.optimizer, **rates),
        densification=replace(config.densification, enabled=densifying, **times),
    )


def steady_trainer(
    config: TrainConfig,
    capture: Capture,
    folder: Path,
    *,
    checkpoint: dict[str, Any] | None = None,
    gaussians: Gaussians | None = None,
) -> Trainer:
    """A trainer that prints nothing, ready for steps with all degrees of the spherical harmonics.

    Args:
        config: From :func:`steady_config`.
        capture: Frames to learn from.
        folder: Where metrics.jsonl goes; it must not hold a run.
        checkpoint: State to start from; None: the capture's points.
        gaussians: What each set of Gaussians becomes a copy of; None: they stay as they are.
    """
    trainer = quiet_trainer(config, capture, folder, checkpoint)
    if gaussians is not None:
        source = gaussians.to(trainer.device)
        for name, owned in trainer.state.gaussian_sets.items():
            become_copy(owned, trainer.state.optimizers[name], source)
            trainer.state.strategies[name].forget(len(owned))
    trainer.state.step = max(trainer.state.step, config.sh_degree + 1)
    return trainer


def quiet_trainer(
    config: TrainConfig, capture: Capture, folder: Path, checkpoint: dict[str, Any] | None = None
) -> Trainer:
    """A trainer that logs as always, but prints nothing."""
    run = RunDirectory.create(folder)
    trainer = Trainer(config, capture, run, checkpoint=checkpoint)
    trainer.logger = RunLogger(
        run,
        max_steps=config.max_steps,
        log_every=config.log_every,
        device=trainer.device,
        tensorboard=False,
        console=Console(quiet=True),
    )
    return trainer


def run_steps(trainer: Trainer, count: int) -> float:
    """Does so many steps; seconds until the device has done them."""
    wait(trainer.device)
    started = time.perf_counter()
    for _ in range(count):
        trainer._train_step()
    wait(trainer.device)
    return time.perf_counter() - started


def warm_up(trainer: Trainer) -> None:
    """Compiles kernels, and lets a trainer that captures its steps see all frames and capture."""
    run_steps(trainer, 2 if trainer.captured is None else len(trainer.frames) + 5)


def wait(device: torch.device) -> None:
    """Until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
