"""YAML files that may come from strangers: plain values only, and no message repeats what another file holds.

Neither the environment nor other files are read into a value (OmegaConf's ``${...}``). Aliases, which can unpack a few
lines to gigabytes, deep nesting and large files are refused before anything is built.
"""

import io
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from thermosplat.config.values import shortened, shown
from thermosplat.errors import UserError

_MOST_BYTES = 1 << 18
"""A whole configuration with all comments has some 10,000 bytes."""
_MOST_LEVELS = 16
"""Groups inside groups; the schema has three levels."""
_INTERPOLATION = "${"
_LONGEST_REASON = 120


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML file, as plain dictionaries, lists, texts and numbers.

    Raises:
        UserError: It cannot be read, is no YAML of keys and values, or has what is refused (see above).
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise UserError(f"{path} has more than {_MOST_BYTES:,} bytes, and is no configuration.")
        text = content.decode()
        _check_structure(text, path)
        values: Any = OmegaConf.to_container(OmegaConf.load(io.StringIO(text)), resolve=False)
    except UserError:
        raise
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, OSError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as YAML: {_reason(error)}.") from error
    _check_plain(values, path)
    return {str(key): value for key, value in values.items()}


def _check_structure(text: str, path: Path) -> None:
    level = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            line = event.start_mark.line + 1
            raise UserError(f"Line {line} of {path} has a YAML alias (*); write the value again.")
        if level == 0 and isinstance(event, yaml.ScalarEvent | yaml.SequenceStartEvent):
            found = "text" if isinstance(event, yaml.ScalarEvent) else "list"
            raise UserError(f"{path} must hold keys and values, found a {found}.")
        level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if level > _MOST_LEVELS:
            raise UserError(f"{path} is nested more than {_MOST_LEVELS} levels deep, and is no configuration.")


def _check_plain(value: Any, path: Path, where: str = "") -> None:
    """Refuse values that OmegaConf would take from the environment or from elsewhere."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check_plain(item, path, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list):
        for item in value:
            _check_plain(item, path, where)
    elif isinstance(value, str) and _INTERPOLATION in value:
        raise UserError(
            f"{path}: {shortened(where)} is {shown(value)}, and {_INTERPOLATION}...}} is not expanded.",
            "Write the value itself, or give it on the command line.",
        )


def _reason(error: Exception) -> str:
    """What is wrong and in which line, without the line itself: the file may be another one than was meant."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem is not None:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f" (line {mark.line + 1}, column {mark.column + 1})"
        return error.problem[:_LONGEST_REASON] + where
    if isinstance(error, UnicodeDecodeError):
        return f"it is not UTF-8 (byte {error.start:,})"
    if isinstance(error, OSError):
        return error.strerror or type(error).__name__
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return " ".join(str(error).split())[:_LONGEST_REASON].rstrip(".")
