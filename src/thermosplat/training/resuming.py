"""Whether a checkpoint is of the model that a configuration describes, and of the capture at hand."""

from dataclasses import fields
from typing import Any

from thermosplat.checkpoint import damage_explained, load_checkpoint
from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.config_files import from_dict
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.run_directory import RunDirectory

_START_ONLY = ("feature_noise", "init_opacity", "init_scale")
"""Fields of ModelConfig that matter before the first step only."""
_THERMAL_IMAGES = {
    "color": "pseudo-coloured thermal images",
    "scalar": "thermal images of one channel",
    None: "no thermal images",
}
"""By the kind of their scale."""
_TRAINING = ("optimizers", "strategies", "exposures", "seconds")
"""What of a checkpoint's training state there has always been; rendering does without."""


def newest_checkpoint(run: RunDirectory) -> dict[str, Any]:
    """The state of a run's newest checkpoint, on the CPU.

    Raises:
        UserError: If there is none, or it cannot be read, or holds a model without the state of its training.
    """
    path = run.latest_checkpoint()
    if path is None:
        raise UserError(f"{run.path} has no checkpoint to go on from.", "Start again with --overwrite.")
    checkpoint = load_checkpoint(path)
    missing = [entry for entry in _TRAINING if entry not in checkpoint["training"]]
    if missing:
        raise UserError(
            f"{path} can be rendered but not trained further: of its training state {', '.join(missing)} are missing.",
            "Start another run with another --result-dir.",
        )
    return checkpoint


def other_frames(then: list[str] | None, capture: Capture) -> str:
    """How a capture's training frames differ from those of a run.

    Args:
        then: Names of the frames that the run was trained on; None: it does not say, and they count as the same.
        capture: The capture.

    Returns:
        A sentence, or "" if they are the same by number and name.
    """
    now = [frame.name for frame in capture.train]
    if then is None or then == now:
        return ""
    strange = [name for name in now if name not in set(then)] or [name for name in then if name not in set(now)] or now
    return (
        f"It was trained on {len(then)} frames, and {capture.root} has {len(now)} training frames "
        f"that are not the same (first difference: {strange[0]})."
    )


def check_resumable(checkpoint: dict[str, Any], config: TrainConfig, run: RunDirectory, capture: Capture) -> None:
    """Refuse to go on with another model than the checkpoint's, or on another capture.

    Args:
        checkpoint: The state.
        config: What the command asks for.
        run: The run, for the message.
        capture: What it would be trained on.

    Raises:
        UserError: Names the first setting that differs, and both values; the first training frame; or both kinds of
            thermal images.
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
    difference = other_frames(checkpoint.get("train_frames"), capture)
    if difference:
        raise UserError(
            f"{run.path} cannot go on with another capture. {difference}",
            "Name the folder it was trained on, or start a new run with another --result-dir.",
        )
    saved_scale, scale = checkpoint["thermal_scale"], capture.thermal_scale
    with damage_explained("thermal scale"):
        trained = _THERMAL_IMAGES[None if saved_scale is None else saved_scale["kind"]]
    found = _THERMAL_IMAGES[None if scale is None else scale.kind]
    if config.model.thermal and trained != found:
        raise UserError(
            f"{run.path} cannot go on with another capture. It was trained on {trained}, and {capture.root} has "
            f"{found}.",
            "Name the folder it was trained on, or start a new run with another --result-dir.",
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
