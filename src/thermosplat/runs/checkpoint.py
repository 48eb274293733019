"""What a checkpoint holds: everything that a run needs to go on, or to be rendered, evaluated and exported.

:mod:`thermosplat.runs.checkpoint_file` writes it as a plain dict of tensors and built-in types (``Checkpoint.state``):

    format         int, FORMAT
    step           int, training steps done
    config         dict, the resolved configuration (``config.files.to_dict``)
    sh_degree      int, highest spherical-harmonics degree in use
    model          {"gaussian_sets": {name: packed state_dict}, "decoders": state_dict | None,
                    "color_spaces": {spectrum: what its images are}, "unscented": bool,
                    "placement": dict (``Placement.state``)}
    scales         {spectrum: dict (``PixelScale.state_dict``)}
    training       dict, see ``SavedTraining``
    train_frames   list of the training frames' names
    test_frames    the same of the held-out frames
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch

from thermosplat.config import TrainConfig
from thermosplat.config.files import from_dict, to_dict
from thermosplat.errors import UserError

FORMAT = 2
DELETE_IT = "Delete it; thermosplat-train --resume then goes on from the checkpoint before it."
"""What to do about a checkpoint that cannot be read."""
_MOST_STEPS = 2**53
_TRAINED_FURTHER = ("optimizers", "strategies", "exposures", "seconds")
"""What of a training there has always been; rendering does without."""


@dataclass(frozen=True)
class SavedModel:
    """The scene (``SceneModel.checkpoint_state``)."""

    gaussian_sets: dict[str, dict[str, torch.Tensor]]
    decoders: dict[str, torch.Tensor] | None
    """Of the pixel-wise networks; None where there are none."""
    color_spaces: dict[str, Any]
    """What the images of each spectrum are."""
    unscented: bool = False
    """Pinhole cameras see it by the unscented transform, since it was trained through lenses or rolling shutters."""
    placement: dict[str, Any] = field(default_factory=dict)
    """Where it lies in the world (``Placement.state``); {} of old checkpoints: it has the world's frame."""


@dataclass(frozen=True)
class SavedTraining:
    """What only training needs (``TrainingState``). Defaults are what checkpoints hold that do not say."""

    optimizers: dict[str, dict[str, Any]] | None = None
    """States of the optimizers, by owner and parameter; None of a trimmed model."""
    strategies: dict[str, dict[str, Any]] | None = None
    exposures: dict[str, torch.Tensor] | None = None
    """Colour changes of the training views; None where no spectrum has them."""
    corrections: dict[str, torch.Tensor] | None = None
    """What is wrong with the cameras; None where nothing of them is refined."""
    camera_passes: int = 0
    """Passes that find the cameras, with the one that the steps done are of; 0: the scene is trained with them."""
    scenes_left: int = 0
    """Scenes that are to be trained before all become one, with the one that the steps done are of; 0: there is one."""
    kept_scenes: tuple[dict[str, dict[str, torch.Tensor]], ...] = ()
    """Those that are trained: parameters of each set, packed."""
    noisy: tuple[str, ...] | None = None
    """Spectra whose images counted as noisy when the run began; None: it does not say."""
    growing: bool = True
    """Whether density control may still add Gaussians."""
    offsets_dropped: bool = False
    """Whether opacity offsets that are zero stay zero."""
    budget_due: tuple[str, ...] = ()
    """What a budget is to leave out before the next step (``AutoBudget.do_what_is_due``)."""
    trimmed: bool = False
    """Whether the model is as small as a budget leaves it at the end."""
    best_validation: tuple[float, int] = (-math.inf, 0)
    """Best PSNR of withheld training views [dB], and its step."""
    noise_watch: dict[str, Any] | None = None
    """How far noisy images are fitted and may be (``NoiseWatch.state_dict``); None where no spectrum has a floor."""
    seconds: dict[str, float] | None = None
    missing: tuple[str, ...] = ()
    """What there must be to train further and is not there."""


@dataclass(frozen=True)
class Checkpoint:
    """A run after a whole number of steps."""

    step: int
    config: TrainConfig
    sh_degree: int
    """Highest degree of the spherical harmonics in use."""
    model: SavedModel
    scales: dict[str, dict[str, Any]]
    """What pixel values mean, by spectrum (``PixelScale.state_dict``)."""
    training: SavedTraining
    train_frames: list[str] | None = None
    """Names of the frames it was trained on; None: it does not say."""
    test_frames: list[str] | None = None
    """Names of the frames it is judged by; None: it does not say."""
    notes: tuple[str, ...] = ()
    """What to tell of settings that it was trained with and that there are no more."""

    def state(self) -> dict[str, Any]:
        """The content of its file."""
        training = {field.name: getattr(self.training, field.name) for field in fields(SavedTraining)}
        missing = training.pop("missing")
        return {
            "format": FORMAT,
            "step": self.step,
            "config": to_dict(self.config),
            "sh_degree": self.sh_degree,
            "model": {field.name: getattr(self.model, field.name) for field in fields(SavedModel)},
            "scales": self.scales,
            "training": {name: value for name, value in training.items() if name not in missing},
            "train_frames": self.train_frames,
            "test_frames": self.test_frames,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], path: Path) -> "Checkpoint":
        """The inverse of ``state``. Every entry is there and of its kind; what is in tensors is not looked at.

        Raises:
            UserError: An entry is missing, or is something else than it must be.
        """
        read = _Reader(state, path)
        for name in ("step", "config", "sh_degree", "model", "scales", "training"):
            read.entry(name, lambda value: True, "there")
        config = read.entry("config", _is_dict, "a dictionary")
        notes: list[str] = []
        try:
            config = from_dict(config, source=f"the configuration in {path}", notes=notes)
        except UserError as error:
            message = f"{error.message} Another version of thermosplat wrote that file."
            raise UserError(message, "Use the version that wrote it, or train again.") from error
        read.entry("model", _is_dict, "a dictionary")
        read.entry("training", _is_dict, "a dictionary")
        training = read.training()
        return cls(
            step=read.entry("step", lambda value: _is_int(value, 0, _MOST_STEPS), "a number of steps"),
            config=config,
            sh_degree=read.entry(
                "sh_degree", lambda value: _is_int(value, 0, config.sh_degree), f"from 0 to {config.sh_degree}"
            ),
            model=SavedModel(
                gaussian_sets=read.entry("model.gaussian_sets", _are_sets, "sets of tensors, at least one"),
                decoders=read.entry("model.decoders", _or_none(_are_tensors), "tensors or None"),
                color_spaces=read.entry("model.color_spaces", _is_dict, "a dictionary"),
                unscented=read.entry(
                    "model.unscented", lambda value: isinstance(value, bool), "a boolean", config.lens == "direct"
                ),
                placement=read.entry("model.placement", _is_dict, "a dictionary", {}),
            ),
            scales=read.entry("scales", _are_dicts, "dictionaries by spectrum"),
            training=training,
            train_frames=read.entry("train_frames", _or_none(_are_names), "a list of names", None),
            test_frames=read.entry("test_frames", _or_none(_are_names), "a list of names", None),
            notes=tuple(notes),
        )


_REQUIRED: Any = object()


class _Reader:
    """Entries of a checkpoint by dotted names, held against what they must be."""

    def __init__(self, state: dict[str, Any], path: Path) -> None:
        self.state = state
        self.path = path

    def entry(self, name: str, fits: Callable[[Any], bool], expected: str, default: Any = _REQUIRED) -> Any:
        """An entry of the state.

        Raises:
            UserError: It is missing though it is required, or does not fit.
        """
        value: Any = self.state
        for key in name.split("."):
            if key not in value:
                if default is _REQUIRED:
                    raise UserError(f"{self.path} is not a complete checkpoint: {name} is missing.", DELETE_IT)
                return default
            value = value[key]
        if not fits(value):
            raise UserError(f"{self.path} is damaged: its {name} must be {expected}, found {_shown(value)}.", DELETE_IT)
        return value

    def training(self) -> SavedTraining:
        """What only training needs. Entries that old versions do not have take the defaults."""
        kinds: dict[str, tuple[Callable[[Any], bool], str]] = {
            "optimizers": (_or_none(_are_dicts), "dictionaries or None"),
            "strategies": (_are_dicts, "dictionaries by set"),
            "exposures": (_or_none(_are_tensors), "tensors or None"),
            "corrections": (_or_none(_are_tensors), "tensors or None"),
            "camera_passes": (_is_count, "a whole number from 0"),
            "scenes_left": (_is_count, "a whole number from 0"),
            "kept_scenes": (_are_scenes, "scenes, each sets of tensors"),
            "noisy": (_or_none(_are_spectra), "names of spectra or None"),
            "growing": (_is_bool, "true or false"),
            "offsets_dropped": (_is_bool, "true or false"),
            "budget_due": (_are_due, "parts of a budget"),
            "trimmed": (_is_bool, "true or false"),
            "best_validation": (_is_validation, "a number of decibels and a step"),
            "noise_watch": (_or_none(_is_dict), "a dictionary or None"),
            "seconds": (_are_seconds, "numbers of seconds"),
        }
        there = self.state["training"]
        found = {
            name: self.entry(f"training.{name}", fits, expected)
            for name, (fits, expected) in kinds.items()
            if name in there
        }
        return SavedTraining(**found, missing=tuple(name for name in _TRAINED_FURTHER if name not in there))


def _shown(value: Any) -> str:
    """A value in a message: a short one as it is, of others their type."""
    text = repr(value) if isinstance(value, bool | int | float | str | None) else ""
    return text if text and len(text) <= 40 else type(value).__name__


def _or_none(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or fits(value)


def _is_int(value: Any, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_dict(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(key, str) for key in value)


def _are_dicts(value: Any) -> bool:
    return _is_dict(value) and all(map(_is_dict, value.values()))


def _are_tensors(value: Any) -> bool:
    return _is_dict(value) and all(isinstance(item, torch.Tensor) for item in value.values())


def _are_sets(value: Any) -> bool:
    return _is_dict(value) and len(value) > 0 and all(item and _are_tensors(item) for item in value.values())


def _are_scenes(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(map(_are_sets, value))


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _are_spectra(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(name, str) and name.isidentifier() for name in value)


def _are_due(value: Any) -> bool:
    return isinstance(value, tuple) and set(value) <= {"prune", "drop_offsets", "reduce_features"}


def _is_validation(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value))


def _are_seconds(value: Any) -> bool:
    return _is_dict(value) and all(_is_number(item) and math.isfinite(item) for item in value.values())


@contextmanager
def damage_explained(part: str) -> Iterator[None]:
    """Around what makes an object of a checkpoint's content: what that lacks is a user's error."""
    try:
        yield
    except UserError:
        raise
    except (AttributeError, IndexError, KeyError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(
            f"The checkpoint is damaged: its {part} cannot be used ({type(error).__name__}: {reason}).",
            "Take another one of the run with --step, or delete it; the one before it is then the newest.",
        ) from error
