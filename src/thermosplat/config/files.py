"""Configurations as YAML: presets that come with the package, files of the user's, the resolved one of a run.

A file states only what differs from its ``base``, another preset or file, or from the schema's defaults (schema.py)
where it names none. Keys are strict: an unknown one is an error that names the nearest known key, and one of a
setting that there is no more says what is done in its place (gone_settings.py).
"""

import os
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from thermosplat.config import TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.gone_settings import without_gone_settings
from thermosplat.config.values import fill, nearest, shortened, shown
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError
from thermosplat.spectra import BUILT_IN_PALETTES

_SUFFIXES = (".yaml", ".yml")


@cache
def presets_folder() -> Path:
    """Folder of the preset files: inside an installed package, or at the top of a source tree.

    Raises:
        UserError: The installation lacks them.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "configs", package.parents[1] / "configs"):
        if (folder / "thermosplat.yaml").is_file():
            return folder
    raise UserError(f"The presets are missing from this installation: no configs/thermosplat.yaml beside {package}.")


def preset_paths() -> dict[str, Path]:
    """File of every preset by its name (the file's stem), in alphabetical order of the names."""
    return {path.stem: path for path in sorted(presets_folder().rglob("*.yaml"), key=lambda path: path.stem)}


def load_config(name_or_path: str | Path) -> TrainConfig:
    """The configuration a preset or a YAML file describes.

    Returns:
        The configuration; its ``config`` field is the name given, unless the file itself states one (as the resolved
        config.yaml of a run does).

    Raises:
        UserError: No such preset or file, unreadable YAML, an unknown key, or a value of the wrong type or range.
    """
    name_or_path = str(name_or_path)
    config = _load(name_or_path, visited=())
    return config if config.config else replace(config, config=Path(name_or_path).stem)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as nested dictionaries of plain values (lists for tuples), for YAML and checkpoints."""
    return OmegaConf.to_container(OmegaConf.create(asdict(config)))  # type: ignore[return-value]


def from_dict(
    values: dict[str, Any], *, source: str = "the configuration", notes: list[str] | None = None
) -> TrainConfig:
    """The inverse of `to_dict`; values that are missing take the schema's defaults.

    Args:
        values: Nested dictionary as `to_dict` makes it.

    Raises:
        UserError: An unknown key, or a value of the wrong type or range.
    """
    try:
        config = fill(TrainConfig(), without_gone_settings(values, source=source, notes=notes), source=source)
    except RecursionError as error:
        raise UserError(f"{source} is nested too deeply to be a configuration.") from error
    check_config(config, source=source)
    return config


def to_yaml(config: TrainConfig) -> str:
    """The whole configuration as YAML that `load_config` reads back to an equal one."""
    return OmegaConf.to_yaml(OmegaConf.create(asdict(config)))


def with_given_steps(values: dict[str, Any]) -> dict[str, Any]:
    """Settings that give a number of steps mean it, whatever the steps of their base are meant for."""
    return {"steps_for_views": None, "noisy_steps": 1.0, **values} if "max_steps" in values else values


def _load(name_or_path: str, visited: tuple[Path, ...]) -> TrainConfig:
    path = _find(name_or_path, visited[-1].parent if visited else Path(), is_base=bool(visited))
    if path in visited:
        raise UserError(f"{path} is its own base: {' -> '.join(file.name for file in (*visited, path))}.")
    values = read_yaml(path)
    base = values.pop("base", None)
    if base is None:
        start = TrainConfig(config="")
    elif isinstance(base, str):
        start = replace(_load(base, (*visited, path)), config="")
    else:
        raise UserError(f"{path}: base must be the name of a preset or a YAML file, found {shown(base)}.")
    config = fill(start, with_given_steps(without_gone_settings(values, source=str(path))), source=str(path))
    check_config(config, source=str(path))
    return config


def _find(name_or_path: str, relative_to: Path, *, is_base: bool) -> Path:
    presets = preset_paths()
    if name_or_path in presets:
        return presets[name_or_path]
    named = relative_to / name_or_path
    for candidate in (named, Path(f"{named}.yaml")):
        # a base is named by a file that may come from a stranger: it is no other file than YAML
        allowed = not is_base or candidate.suffix in _SUFFIXES
        if allowed and os.path.isfile(candidate):  # False also for a name that is too long
            return candidate.resolve()
    if Path(name_or_path).suffix in _SUFFIXES:
        raise UserError(f"There is no configuration file {shortened(name_or_path)}.", f"Presets: {', '.join(presets)}.")
    raise UserError(
        f'"{shortened(name_or_path)}" is neither a preset nor a YAML file{nearest(name_or_path, presets)}.',
        f"Presets: {', '.join(presets)}.",
    )


def data_from_anywhere(data: str) -> str:
    """What names a capture (``TrainConfig.data``) as a run keeps it: a path that holds from any directory."""
    return data if data == "sample" else _from_anywhere(data)


def files_from_anywhere(config: TrainConfig) -> TrainConfig:
    """The configuration with the other files that a run reads, palettes and LPIPS weights, by such paths too."""
    spectra = {
        name: spectrum
        if spectrum.palette is None or spectrum.palette in BUILT_IN_PALETTES
        else replace(spectrum, palette=_from_anywhere(spectrum.palette))
        for name, spectrum in config.spectra.items()
    }
    weights = None if config.lpips_weights is None else _from_anywhere(config.lpips_weights)
    return replace(config, spectra=spectra, lpips_weights=weights)


def _from_anywhere(path: str) -> str:
    return str(Path(os.path.expanduser(path)).resolve())
