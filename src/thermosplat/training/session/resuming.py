"""Whether a checkpoint is of the model that a configuration describes, and of the capture at hand."""

from dataclasses import fields
from typing import Any

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.placement import Placement
from thermosplat.distributed.team import Team
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import other_frames
from thermosplat.runs.checkpoint import Checkpoint, damage_explained
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.spectra import STRUCTURE, label, latent_channels
from thermosplat.training.sharing.shares import shares_of

_START_ONLY = ("init_opacity",)
"""Fields of ModelConfig that matter before the first step only."""
_IMAGES = {
    "photograph": "photographs as {} images",
    "color": "pseudo-coloured {} images",
    "scalar": "{} images of one channel",
    "labels": "{} images of classes",
    "stack": "{} images of many channels",
    None: "no {} images",
}
"""By the kind of their scale."""


def newest_checkpoint(run: RunDirectory) -> Checkpoint:
    """The state of a run's newest checkpoint, on the CPU.

    Raises:
        UserError: If there is none, or it cannot be read, or holds a model without the state of its training.
    """
    path = run.latest_checkpoint()
    if path is None:
        raise UserError(f"{run.path} has no checkpoint to go on from.", "Start again with --overwrite.")
    checkpoint = load_checkpoint(path)
    if missing := checkpoint.training.missing:
        raise UserError(
            f"{path} can be rendered but not trained further: of its training state {', '.join(missing)} are missing.",
            "Start another run with another --result-dir.",
        )
    return checkpoint


def share_to_go_on_from(config: TrainConfig, capture: Capture, run: RunDirectory, team: Team) -> Checkpoint:
    """This rank's share of a run's newest checkpoint, which may be of another number of ranks; rank 0 reads it.

    Args:
        team: The ranks; one alone has all.

    Raises:
        UserError: On rank 0, as of ``newest_checkpoint`` and ``check_resumable``.
        EndedElsewhere: On the others.
    """

    def read() -> Checkpoint:
        checkpoint = newest_checkpoint(run)
        check_resumable(checkpoint, config, run, capture)
        return checkpoint

    if team.is_alone:
        return read()
    shares: list[Checkpoint] = []
    team.asked_of_first(lambda: shares.extend(shares_of(read(), team.size)))
    share: Checkpoint = team.dealt(shares if team.is_first else None)
    return share


def check_resumable(checkpoint: Checkpoint, config: TrainConfig, run: RunDirectory, capture: Capture) -> None:
    """Refuse to go on with another model than the checkpoint's, or on another capture.

    Raises:
        UserError: Names the first setting that differs, and both values; the first training frame; or both kinds of
            images of a spectrum.
    """
    then, now = _structure(checkpoint.config), _structure(config)
    for name, value in then.items():
        if now.get(name) != value:
            raise UserError(
                f"{run.path} was trained with {name}={value}, the command asks for {now.get(name)}.",
                "Drop the flag, or start a new run with another --result-dir.",
            )
    difference = other_frames(checkpoint.train_frames, capture)
    if difference:
        raise UserError(
            f"{run.path} cannot go on with another capture. {difference}",
            "Name the folder it was trained on, or start a new run with another --result-dir.",
        )
    for name in config.modelled:
        with damage_explained("scales"):
            saved_scale = checkpoint.scales.get(name)
            trained = _IMAGES[None if saved_scale is None else saved_scale["kind"]]
        scale = capture.scales.get(name)
        found = _IMAGES[None if scale is None else scale.kind]
        if trained != found:
            raise UserError(
                f"{run.path} cannot go on with another capture. It was trained on {trained.format(label(name))}, and "
                f"{capture.root} has {found.format(label(name))}.",
                "Name the folder it was trained on, or start a new run with another --result-dir.",
            )


def placed_as_trained(capture: Capture, checkpoint: Checkpoint) -> Capture:
    """The capture in the frame of a checkpoint's scene.

    Raises:
        UserError: The checkpoint is damaged.
    """
    with damage_explained("placement"):
        return capture.placed(Placement.from_state(checkpoint.model.placement))


def check_steps_left(checkpoint: Checkpoint, config: TrainConfig, run: RunDirectory) -> None:
    """Refuse to go on to fewer steps than are done.

    Raises:
        UserError: Has both numbers.
    """
    if config.max_steps < checkpoint.step:
        raise UserError(
            f"{run.path} has done {checkpoint.step:,} steps, the command asks for {config.max_steps:,} in all.",
            "Give a larger --max-steps, or start a new run with another --result-dir.",
        )


def _structure(config: TrainConfig) -> dict[str, Any]:
    """The settings that decide which parameters there are, by flag name."""
    structure: dict[str, Any] = {"sh_degree": config.sh_degree, "spectra": " ".join(config.modelled)}
    structure["scenes"] = config.scenes
    structure["refine"] = " ".join(sorted(config.refine)) or "nothing"
    for name, ends in latent_channels(config.modelled).items():
        spectrum = config.modelled[name]
        structure |= {f"spectra.{name}.{key}": getattr(spectrum, key) for key in STRUCTURE}
        structure[f"spectra.{name}.features"] = "null" if ends[0] == ends[1] else "a number"
    for field in fields(ModelConfig):
        if field.name not in _START_ONLY:
            structure[f"model.{field.name}"] = getattr(config.model, field.name)
    for field in fields(config.decoder):
        structure[f"decoder.{field.name}"] = getattr(config.decoder, field.name)
    return structure
