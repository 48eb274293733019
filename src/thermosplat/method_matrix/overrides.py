"""Settings of a matrix that differ from its methods' presets: --set [CELLS:]FIELD=VALUE.

CELLS is a method, a scene, or scene/method; without it the setting is that of every cell.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from thermosplat.config import TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.files import with_given_steps
from thermosplat.config.gone_settings import without_gone_settings
from thermosplat.config.values import fill, nearest
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import Cell

_NOT_TO_BE_SET = {
    "data": "Name the scene.",
    "config": "Name the method.",
    "seed": "Use --seeds.",
    "eval_steps": "Held-out views are looked at once, at the end.",
    "save_steps": "Use --save-every.",
    "device": "Use --devices or --gpus.",
    **dict.fromkeys(("result_dir", "resume", "overwrite"), "Use --out."),
}


@dataclass(frozen=True)
class Override:
    """A setting that some cells, or all, shall have."""

    word: str
    cells: str
    """Method, scene or scene/method; empty: every cell."""
    values: dict[str, Any]
    """The setting as nested dictionaries."""

    def concerns(self, cell: Cell) -> bool:
        """Whether a cell shall have the setting."""
        return self.cells in ("", cell.method, cell.scene, f"{cell.scene}/{cell.method}")

    def applied(self, config: TrainConfig) -> TrainConfig:
        """A configuration with the setting.

        Raises:
            UserError: There is no such field, or the value does not fit it, or not to the other settings.
        """
        source = f"--set {self.word}"
        values = with_given_steps(without_gone_settings(self.values, source=source))
        changed = fill(config, values, source=source)
        check_config(changed, source=source)
        return changed


def parse_overrides(words: Iterable[str], scenes: Collection[str], methods: Collection[str]) -> tuple[Override, ...]:
    """Settings of a command line.

    Args:
        words: [CELLS:]FIELD=VALUE each, with the field as in a YAML file, groups with a dot.

    Raises:
        UserError: Another form, cells that are not in the matrix, or a field that the matrix decides.
    """
    known = ["", *methods, *scenes, *(f"{scene}/{method}" for scene in scenes for method in methods)]
    return tuple(_parse(word, known) for word in words)


def _parse(word: str, known: Collection[str]) -> Override:
    left, equals, value = word.partition("=")
    cells, colon, field = left.rpartition(":")
    example = "For example: --set 3dgs:densification.max_gaussians=150000"
    if not equals or not field or (colon and not cells):
        raise UserError(f"--set takes [CELLS:]FIELD=VALUE, found {word}.", example)
    if cells not in known:
        hint = "Name one of the methods or scenes of this command, or SCENE/METHOD."
        raise UserError(f'--set {word}: no cell of this matrix is called "{cells}"{nearest(cells, known)}.', hint)
    if field in _NOT_TO_BE_SET:
        raise UserError(f"--set {word}: {field} is not a setting of a method.", _NOT_TO_BE_SET[field])
    try:
        values = OmegaConf.to_container(OmegaConf.from_dotlist([f"{field}={value}"]))
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise UserError(f"--set {word} cannot be read: {' '.join(str(error).split())}.", example) from error
    if not isinstance(values, dict):
        raise UserError(f"--set takes [CELLS:]FIELD=VALUE, found {word}.", example)
    return Override(word, cells, {str(key): item for key, item in values.items()})
