"""The schedule that a run follows, where its configuration speaks of steps of one frame, of ``steps_scaler``, and of so
many training views without much noise.

Grendel (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 4) counts training in images, divides
a step's loss by its number of frames B, and scales Adam so that B steps of one frame and one step of B lead about as
far: rates times √B, decay rates β of the moments to the power of B. A parameter's own decay is in units of its rate, so
it takes √B, too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from thermosplat.config.schema import TrainConfig
from thermosplat.spectra import listed

ADAM_BETAS = (0.9, 0.999)
"""Decay of Adam's moments in a step of one frame. 3DGS: torch's defaults."""
LONGEST = 30_000
"""Steps of one frame up to which a capture may ask for more of them. 3DGS's number, whatever the capture."""
_OF_RUN = ("sh_degree_interval", "refine_from")
_OF_CAMERAS = ("refine_every", "refine_first", "refine_rounds_from")
"""How long finding cameras takes, however long the scene is trained."""
_OF_DENSIFICATION = ("start_step", "stop_step", "every", "reset_every")
_OF_BUDGET = ("validate_every",)


def scaled_steps(steps: int, factor: float) -> int:
    """So many times a number of steps, rounded up."""
    return math.ceil(round(steps * factor, 6))


def in_steps(config: TrainConfig, max_steps: int | None = None) -> TrainConfig:
    """The configuration with schedules in steps of one frame, where they are shares of the run.

    Args:
        config: The configuration; without shares it is returned as it is.
        max_steps: Of how many steps they are shares, to the nearest step but 0. None: of the configuration's.
    """
    of = config.max_steps if max_steps is None else max_steps

    def counted(group: Any, names: tuple[str, ...]) -> dict[str, Any]:
        shares = {name: getattr(group, name) for name in names if isinstance(getattr(group, name), float)}
        return {name: max(round(share * of), int(share > 0)) for name, share in shares.items()}

    run, budget = counted(config, _OF_RUN), counted(config.auto_budget, _OF_BUDGET)
    densification = counted(config.densification, _OF_DENSIFICATION)
    if not (run or budget or densification):
        return config
    return replace(
        config,
        **run,
        densification=replace(config.densification, **densification),
        auto_budget=replace(config.auto_budget, **budget),
    )


def _asked_by_capture(config: TrainConfig, views: int, noisy: Sequence[str]) -> dict[str, float]:
    """Why a capture asks for more steps than the configuration's, and by each reason how many times as many.

    Args:
        config: The configuration; ``steps_for_views`` and ``noisy_steps`` say when.
        views: Training views of the capture, a frame with images of several spectra being one.
    """
    asked = {}
    if config.steps_for_views is not None and views > config.steps_for_views:
        asked[f"{views:,} training views, more than {config.steps_for_views:,}"] = views / config.steps_for_views
    if noisy and config.noisy_steps > 1:
        asked[f"noisy {listed(noisy)} images"] = config.noisy_steps
    return asked


def _capture_factor(config: TrainConfig, asked: Mapping[str, float]) -> float:
    """How many times the configuration's steps a capture gets."""
    return max(1.0, min(math.prod(asked.values()), LONGEST / config.max_steps))


def steps_note(config: TrainConfig, views: int, noisy: Sequence[str]) -> tuple[str, ...]:
    """What to tell a user whose capture gets more steps; nothing where it does not."""
    asked = _asked_by_capture(config, views, noisy)
    factor = _capture_factor(config, asked)
    if factor == 1:
        return ()
    usual = scaled_steps(config.max_steps, config.steps_scaler)
    longer = scaled_steps(config.max_steps, config.steps_scaler * factor)
    why = ", and ".join(asked)
    return (
        f"{why[0].upper()}{why[1:]}: {longer:,} steps of one frame in place of {usual:,} (--max-steps gives another "
        "number).",
    )


def run_schedule(config: TrainConfig, views: int = 0, noisy: Sequence[str] = ()) -> TrainConfig:
    """What a run does: with ``steps_scaler``, for its training images, and in steps of its ``batch_size`` frames.

    The result has no shares and nothing left to scale by, so that it is checked and kept as what is done.

    Args:
        config: The configuration; with nothing to scale by, and no shares, it is returned as it is.
        views: Training views of the capture; 0 where they are not known.
    """
    size = config.batch_size or 1
    of_capture = _capture_factor(config, _asked_by_capture(config, views, noisy))
    config = in_steps(config)
    if size == config.steps_scaler == of_capture == 1:
        return config
    factor = config.steps_scaler * of_capture / size

    def scaled(group: Any, names: tuple[str, ...], factor: float = factor) -> dict[str, Any]:
        return {name: scaled_steps(getattr(group, name), factor) for name in names}

    rates = {field.name: getattr(config.optimizer, field.name) for field in fields(config.optimizer)}
    is_rate = {name: name.endswith(("_lr", "_lr_final", "_decay")) for name in rates}
    return replace(
        config,
        steps_scaler=1.0,
        steps_for_views=None,
        noisy_steps=1.0,
        **scaled(config, ("max_steps", *_OF_RUN)),
        **scaled(config, _OF_CAMERAS, 1 / size),
        eval_steps=tuple(scaled_steps(step, factor) for step in config.eval_steps),
        save_steps=tuple(scaled_steps(step, factor) for step in config.save_steps),
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
