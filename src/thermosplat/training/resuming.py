"""Whether a checkpoint and a configuration describe the same model."""

from dataclasses import fields
from typing import Any

from thermosplat.checkpoint import load_checkpoint
from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.config_files import from_dict
from thermosplat.errors import UserError
from thermosplat.run_directory import RunDirectory

_START_ONLY = ("feature_noise", "init_opacity", "init_scale")
"""Fields of ModelConfig that matter before the first step only."""


def newest_checkpoint(run: RunDirectory) -> dict[str, Any]:
    """The state of a run's newest checkpoint, on the CPU.

    Raises:
        UserError: If there is none, or it cannot be read.
    """
    path = run.latest_checkpoint()
    if path is None:
        raise UserError(f"{run.path} has no checkpoint to go on from.", "Start again with --overwrite.")
    return load_checkpoint(path)


def check_resumable(checkpoint: dict[str, Any], config: TrainConfig, run: RunDirectory) -> None:
    """Refuse to go on with another model than the checkpoint's.

    Args:
        checkpoint: The state.
        config: What the command asks for.
        run: The run, for the message.

    Raises:
        UserError: Names the first setting that differs, and both values.
    """
    saved = from_dict(checkpoint["config"], source=f"{run.path}'s checkpoint")
    then, now = _structure(saved), _structure(config)
    for name, value in then.items():
        if now[name] != value:
            raise UserError(
                f"{run.path} was trained with {name}={value}, the command asks for {now[name]}.",
                "Drop the flag, or start a new run with another --result-dir.",
            )
    if config.max_steps < checkpoint["step"]:
        raise UserError(
            f"{run.path} has done {checkpoint['step']:,} steps, the command asks for {config.max_steps:,} in all.",
            "Give a larger --max-steps, or start a new run with another --result-dir.",
        )


def _structure(config: TrainConfig) -> dict[str, Any]:
    """The settings that decide which parameters there are, by flag name."""
    structure: dict[str, Any] = {"sh_degree": config.sh_degree}
    for field in fields(ModelConfig):
        if field.name not in _START_ONLY:
            structure[f"model.{field.name}"] = getattr(config.model, field.name)
    for field in fields(config.decoder):
        structure[f"decoder.{field.name}"] = getattr(config.decoder, field.name)
    return structure
