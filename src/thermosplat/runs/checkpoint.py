"""Checkpoints: one file with everything a run needs to go on, written so that a crash never leaves half of one.

A checkpoint is a plain dict of tensors and built-in types (``torch.load(..., weights_only=True)`` reads it):

    format         int, this file's FORMAT
    step           int, training steps done
    config         dict, the resolved configuration (``config_files.to_dict``)
    sh_degree      int, highest spherical-harmonics degree in use
    model          {"gaussian_sets": {name: packed state_dict}, "decoders": state_dict | None,
                    "color_spaces": {spectrum: what its images are}}
    scales         {spectrum: dict (``PixelScale.state_dict``)}
    training       dict, optimizer and densification state (``training.training_state``)
    train_frames   list of the training frames' names; checkpoints of 0.1.0 have none
    test_frames    the same of the held-out frames
"""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from thermosplat.config.files import from_dict
from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import write_atomically
from thermosplat.runs.old_checkpoints import OLD_FORMAT, as_today

FORMAT = 2
_REQUIRED: dict[str, tuple[str, ...]] = {
    "step": (),
    "config": (),
    "sh_degree": (),
    "model": ("gaussian_sets", "decoders", "color_spaces"),
    "scales": (),
    "training": (),
}
"""What a checkpoint must have, and what of it must lie in which entry."""
_REQUIRED_OLD = _REQUIRED | {"model": ("gaussian_sets", "decoders", "thermal_channels"), "thermal_scale": ()}
"""The same of format 1."""


def save_checkpoint(path: Path, state: dict[str, Any]) -> Path:
    """Write a checkpoint, atomically.

    Args:
        path: The file to write.
        state: See the head of this file; ``format`` is added.

    Returns:
        The file.

    Raises:
        NotWrittenError: If the file cannot be written.
    """

    def write(temporary: Path) -> None:
        try:
            with temporary.open("wb") as file:
                torch.save({"format": FORMAT, **state}, file)
        except RuntimeError as error:  # torch's archive writer hides the OSError of a full disk in its own error
            if isinstance(error.__context__, OSError):
                raise error.__context__ from error
            raise

    write_atomically(path, write)
    return path


@torch.no_grad()
def on_host(state: Any) -> Any:
    """A checkpoint's content in tensors of its own, in the host's memory, which no training changes.

    Args:
        state: Tensors and built-in types, in dicts, lists and tuples.
    """
    if isinstance(state, torch.Tensor):
        return state.to("cpu", copy=True)
    if isinstance(state, dict):
        return {key: on_host(value) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return type(state)(on_host(value) for value in state)
    return state


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Args:
        path: A file that :func:`save_checkpoint` wrote.
        device: Where its tensors go.

    Returns:
        The state; see the head of this file.

    Raises:
        UserError: If there is no such file, or it is not a checkpoint this version reads.
    """
    if not path.is_file():
        raise UserError(f"No checkpoint at {path}.", "Give the result folder of a run of thermosplat-train.")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{path} is damaged or not a thermosplat checkpoint ({reason}).",
            "Delete it; thermosplat-train --resume then goes on from the checkpoint before it.",
        ) from error
    if not isinstance(state, dict) or "format" not in state:
        raise UserError(f"{path} is not a thermosplat checkpoint: it has no format number.")
    if state["format"] not in (OLD_FORMAT, FORMAT):
        raise UserError(
            f"{path} has checkpoint format {state['format']}; this version of thermosplat reads format {FORMAT}.",
            "Use the version of thermosplat that wrote it.",
        )
    required = _REQUIRED if state["format"] == FORMAT else {k: v for k, v in _REQUIRED_OLD.items() if k != "scales"}
    missing = _missing(state, required)
    if missing:
        raise UserError(
            f"{path} is not a complete checkpoint: {', '.join(missing)} missing.",
            "Delete it; thermosplat-train --resume then goes on from the checkpoint before it.",
        )
    try:
        from_dict(state["config"], source=f"the configuration in {path}")
    except UserError as error:
        message = f"{error.message} Another version of thermosplat wrote that file."
        raise UserError(message, "Use the version that wrote it, or train again.") from error
    if state["format"] == OLD_FORMAT:
        with damage_explained("content"):
            state = as_today(state)
    return state


@contextmanager
def damage_explained(part: str) -> Iterator[None]:
    """Around what makes an object of a checkpoint's content: what that lacks is a user's error.

    Args:
        part: What of the checkpoint it is.
    """
    try:
        yield
    except UserError:
        raise
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(
            f"The checkpoint is damaged: its {part} cannot be used ({type(error).__name__}: {reason}).",
            "Take another one of the run with --step, or delete it; the one before it is then the newest.",
        ) from error


def _missing(state: dict[str, Any], required: dict[str, tuple[str, ...]]) -> list[str]:
    """What a checkpoint lacks, by dotted names."""
    missing = [key for key in required if key not in state]
    for key in ("config", "model", "training"):
        if key in state and not isinstance(state[key], dict):
            missing.append(key)
    for key, entries in required.items():
        if key not in missing:
            missing += [f"{key}.{entry}" for entry in entries if entry not in state[key]]
    if not missing:
        sets = state["model"]["gaussian_sets"]
        if not isinstance(sets, dict):
            return ["model.gaussian_sets"]
        missing = [f"model.gaussian_sets.{name}" for name, values in sets.items() if not values]
        if state.get("thermal_scale") is not None and not state["thermal_scale"]:
            missing.append("thermal_scale")
    return missing
