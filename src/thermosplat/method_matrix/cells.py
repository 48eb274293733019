"""Which cells a matrix has, and with which configuration each is trained. Imports nothing heavy."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from thermosplat.config import TrainConfig
from thermosplat.config.files import data_from_anywhere, load_config, preset_paths, to_dict, with_given_steps
from thermosplat.config.run_schedule import in_steps
from thermosplat.errors import UserError

REFERENCE_STEPS = 30_000
"""The steps of ThermoSplat and of most methods, in proportion to which a shorter matrix shortens all of them."""

_NOT_SETTINGS = (
    *("data", "result_dir", "resume", "overwrite", "config", "device", "graph", "compile"),
    *("eval_steps", "save_steps", "log_every", "tensorboard", "lpips_weights", "image_memory"),
)
"""Fields that say where and how a cell is computed, not what it computes."""


@dataclass(frozen=True)
class Scene:
    """A capture of the matrix."""

    name: str
    data: str


@dataclass(frozen=True)
class Cell:
    """One method on one scene with one seed."""

    scene: str
    method: str
    """The method's name: its preset, or its YAML file's stem."""
    seed: int

    def folder(self, out: Path) -> Path:
        """The cell's run folder in a matrix's folder."""
        return out / self.scene / self.method / f"seed_{self.seed}"

    def __str__(self) -> str:
        return f"{self.scene} / {self.method} / seed {self.seed}"


def parse_scenes(words: Iterable[str]) -> list[Scene]:
    """Scenes of a command line.

    Args:
        words: Folders, "sample", or NAME=FOLDER where the tables shall show another name than the folder's.

    Raises:
        UserError: A folder that is not there, or two scenes of one name.
    """
    scenes: list[Scene] = []
    for word in words:
        name, _, data = ("", "", word) if Path(data_from_anywhere(word)).is_dir() else word.rpartition("=")
        if data != "sample" and not Path(data_from_anywhere(data)).is_dir():
            raise UserError(f"There is no capture folder {data}.", "Give folders, or NAME=FOLDER.")
        data = data_from_anywhere(data)
        scenes.append(Scene(name or Path(data).name, data))
    names = [scene.name for scene in scenes]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"Two scenes are called {name}.", "Tell them apart: NAME=FOLDER.")
    return scenes


def parse_methods(words: Iterable[str]) -> dict[str, str]:
    """Methods of a command line.

    Args:
        words: Presets, YAML files, or the folders of presets "baselines" and "ablations".

    Returns:
        Preset or file by the method's name, in the order asked for, each once.

    Raises:
        UserError: Neither, or two files of one name.
    """
    presets = preset_paths()
    methods: dict[str, str] = {}
    for word in words:
        group = {name: name for name, path in presets.items() if path.parent.name == word}
        if not group:
            load_config(word)  # or say what is wrong with it
        for name, preset in (group or {Path(word).stem if word not in presets else word: word}).items():
            if methods.setdefault(name, preset) != preset:
                raise UserError(f"Two methods are called {name}: {methods[name]} and {preset}.", "Rename a file.")
    return methods


def method_group(method: str) -> str:
    """The folder of presets that a method comes from: "baselines", "ablations", or something else."""
    path = preset_paths().get(method)
    return "" if path is None else path.parent.name


def cell_config(
    preset: str, scene: Scene, seed: int, *, max_steps: int | None = None, save_every: int = 0, **changes: Any
) -> TrainConfig:
    """The configuration of a cell.

    Args:
        max_steps: Steps of a method that has 30,000; others in proportion. None: as the method has it.
        save_every: Steps between checkpoints; 0: only the last step's.
    """
    config = load_config(preset)
    if max_steps is not None:
        steps = max(1, round(config.max_steps * max_steps / REFERENCE_STEPS))
        config = replace(config, **with_given_steps({"max_steps": steps}))
    return replace(
        config,
        data=scene.data,
        seed=seed,
        eval_steps=(),  # held-out views are looked at once, when nothing can follow from it any more
        save_steps=tuple(range(save_every, config.max_steps, save_every)) if save_every > 0 else (),
        tensorboard=False,
        **changes,
    )


def settings(config: TrainConfig) -> dict[str, Any]:
    """What a cell computes, as JSON has it: two cells with equal settings may stand for each other."""
    values = {name: value for name, value in to_dict(in_steps(config)).items() if name not in _NOT_SETTINGS}
    return json.loads(json.dumps(values))  # tuples become lists, as in a file


def difference(made: dict[str, Any], asked: dict[str, Any]) -> str:
    """The first setting in which two differ, as text; empty where there is none."""
    for name, value in asked.items():
        then = made.get(name)
        if isinstance(value, dict) and isinstance(then, dict):
            inner = difference(then, value)
            if inner:
                return f"{name}.{inner}"
        elif then != value:
            return f"{name}={then}, now {value}"
    return ""
