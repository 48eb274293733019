"""Steps of several frames: the schedule and the rates that see the same images as steps of one.

Grendel (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 4) counts training in images, divides
a step's loss by its number of frames B, and scales Adam so that B steps of one frame and one step of B lead about as
far: rates times √B, decay rates β of the moments to the power of B. A parameter's own decay is in units of its rate, so
it takes √B, too.
"""

import math
from dataclasses import fields, replace
from typing import Any

from thermosplat.config.schema import TrainConfig

ADAM_BETAS = (0.9, 0.999)
"""Decay of Adam's moments in a step of one frame. 3DGS: torch's defaults."""
_NUMBERS_OF_STEPS = (
    "max_steps",
    "sh_degree_interval",
    "refine_from",
    "refine_every",
    "refine_first",
    "refine_rounds_from",
)
_OF_DENSIFICATION = ("start_step", "stop_step", "every", "prune_large_from", "reset_every")
_OF_BUDGET = ("validate_every", "patience", "spectrum_patience")


def steps_of_batches(steps: int, batch_size: int) -> int:
    """Steps of so many frames that see at least the images of ``steps`` steps of one."""
    return math.ceil(steps / batch_size)


def in_batches(config: TrainConfig) -> TrainConfig:
    """What a run does in steps of its ``batch_size`` frames, where the configuration speaks of steps of one.

    Args:
        config: The configuration; without a batch size, or with 1, it is returned as it is.
    """
    size = config.batch_size or 1
    if size == 1:
        return config

    def scaled(group: Any, names: tuple[str, ...]) -> dict[str, Any]:
        return {name: steps_of_batches(getattr(group, name), size) for name in names}

    rates = {field.name: getattr(config.optimizer, field.name) for field in fields(config.optimizer)}
    is_rate = {name: name.endswith(("_lr", "_lr_final", "_decay")) for name in rates}
    return replace(
        config,
        **scaled(config, _NUMBERS_OF_STEPS),
        eval_steps=tuple(steps_of_batches(step, size) for step in config.eval_steps),
        save_steps=tuple(steps_of_batches(step, size) for step in config.save_steps),
        densification=replace(config.densification, **scaled(config.densification, _OF_DENSIFICATION)),
        auto_budget=replace(config.auto_budget, **scaled(config.auto_budget, _OF_BUDGET)),
        optimizer=replace(
            config.optimizer,
            **{name: rate * math.sqrt(size) if is_rate[name] else rate for name, rate in rates.items()},
        ),
    )


def adam_betas(batch_size: int) -> tuple[float, float]:
    """Decay of Adam's moments in a step of so many frames."""
    first, second = ADAM_BETAS
    return first**batch_size, second**batch_size
