"""Entries of a checkpoint are held to what they must be; what old ones lack has its defaults in one place."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.config.files import to_dict
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint import Checkpoint, SavedTraining, damage_explained

PATH = Path("run/ckpts/step_000007.pt")


def _state(**changes: Any) -> dict[str, Any]:
    state = {
        "step": 7,
        "config": to_dict(TrainConfig(max_steps=12, sh_degree=2)),
        "sh_degree": 1,
        "model": {
            "gaussian_sets": {"shared": {"means": torch.zeros(4, 3)}},
            "decoders": None,
            "color_spaces": {"rgb": "photograph", "thermal": "color"},
        },
        "scales": {"thermal": {"kind": "color"}},
        "training": {"optimizers": None, "strategies": {}, "exposures": None, "seconds": {"train": 1.5}},
    }
    for name, value in changes.items():
        *outer, inner = name.split("__")
        entries: Any = state
        for key in outer:
            entries = entries[key]
        entries[inner] = value
    return state


def test_defaults_of_old_versions() -> None:
    """What a checkpoint of 0.1.0 does not say is what held then."""
    checkpoint = Checkpoint.from_state(_state(), PATH)
    assert checkpoint.train_frames is None
    assert checkpoint.test_frames is None
    assert checkpoint.training == SavedTraining(strategies={}, seconds={"train": 1.5})
    assert (checkpoint.training.growing, checkpoint.training.trimmed) == (True, False)
    assert checkpoint.training.best_validation == (-math.inf, 0)
    assert checkpoint.config == TrainConfig(max_steps=12, sh_degree=2)


def test_a_model_alone_says_what_it_lacks() -> None:
    """It can be rendered; what training needs of it is named, and stays away when it is written again."""
    checkpoint = Checkpoint.from_state(_state(training={"exposures": None}), PATH)
    assert checkpoint.training.missing == ("optimizers", "strategies", "seconds")
    assert Checkpoint.from_state(checkpoint.state(), PATH) == checkpoint


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("step", -1, "step must be a number of steps, found -1"),
        ("step", 10**400, "step must be a number of steps, found int"),
        ("step", True, "step must be a number of steps, found True"),
        ("step", torch.tensor(7), "step must be a number of steps, found Tensor"),
        ("sh_degree", 3, "sh_degree must be from 0 to 2, found 3"),
        ("model", None, "model must be a dictionary, found None"),
        ("model__gaussian_sets", {}, "model.gaussian_sets must be sets of tensors, at least one, found dict"),
        ("model__gaussian_sets", {"shared": {}}, "model.gaussian_sets must be"),
        ("model__gaussian_sets", {"shared": {"means": [1.0]}}, "model.gaussian_sets must be"),
        ("model__decoders", {"weight": 3}, "model.decoders must be tensors or None"),
        ("model__color_spaces", ["color"], "model.color_spaces must be"),
        ("scales", {"thermal": "color"}, "scales must be dictionaries by spectrum"),
        ("training", 5, "training must be a dictionary, found 5"),
        ("training__optimizers", {"shared": 5}, "training.optimizers must be"),
        ("training__strategies", None, "training.strategies must be"),
        ("training__growing", "yes", "training.growing must be true or false, found 'yes'"),
        ("training__noisy", ("rgb\n",), "training.noisy must be names of spectra or None, found tuple"),
        ("training__best_validation", (1.0,), "training.best_validation must be"),
        ("training__noise_watch", [1.0], "training.noise_watch must be a dictionary or None, found list"),
        ("training__seconds", {"train": math.nan}, "training.seconds must be numbers of seconds"),
        ("train_frames", 5, "train_frames must be a list of names, found 5"),
        ("test_frames", ["a", 3], "test_frames must be a list of names, found list"),
    ],
)
def test_entries_of_another_kind_are_refused(entry: str, value: object, message: str) -> None:
    """The message names the file, the entry, what it must be, and what it is."""
    with pytest.raises(UserError, match=f"{PATH} is damaged: its {message}"):
        Checkpoint.from_state(_state(**{entry: value}), PATH)


@pytest.mark.parametrize("error", [KeyError("means"), RuntimeError("size mismatch\nfor weight"), TypeError("no list")])
def test_content_that_cannot_be_used_is_a_user_error(error: Exception) -> None:
    """What an object lacks is said in a sentence; what is one already stays."""
    with pytest.raises(UserError, match=rf"its model cannot be used \({type(error).__name__}: [^\n]*\)"):  # noqa: SIM117
        with damage_explained("model"):
            raise error
    with pytest.raises(UserError, match=r"^mine$"), damage_explained("model"):
        raise UserError("mine")
