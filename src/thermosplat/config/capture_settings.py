"""What a capture recommends for its training: the file train.yaml in its folder, which thermosplat-prepare writes.

Its settings stand between the preset's and the command line's. It may come from strangers, so it can say how cameras
are refined and what the images of a spectrum are, and nothing that names a file or decides how long a run goes.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

from thermosplat.config.checks import check_config
from thermosplat.config.schema import TrainConfig
from thermosplat.config.values import fill
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError

RECOMMENDED = "train.yaml"
_GROUPS = ("refine", "spectra")
_OF_SPECTRA = ("exposure", "unit", "range")


def with_recommendations(preset: TrainConfig, data: str) -> tuple[TrainConfig, Path | None]:
    """A preset with what a capture recommends.

    Args:
        data: Folder of the capture; "" or another name for none.

    Returns:
        The configuration, and the file that changed it, if there is one.

    Raises:
        UserError: The file is damaged, or has settings that are not for it.
    """
    path = Path(os.path.expanduser(data)) / RECOMMENDED
    if not data or not path.is_file():
        return preset, None
    hint = f"Correct or remove it; thermosplat-prepare check {path.parent} writes it again."
    try:
        values = read_yaml(path)
    except UserError as error:
        raise UserError(error.message, hint) from error
    _refuse_others(values, preset, path, hint)
    config = fill(preset, values, source=str(path))
    check_config(dataclasses.replace(config, data=config.data or data), source=str(path))
    return config, path


def _refuse_others(values: dict[str, Any], preset: TrainConfig, path: Path, hint: str) -> None:
    if not set(values) <= set(_GROUPS):
        raise UserError(f"{path} may have the settings {' and '.join(_GROUPS)} only.", hint)
    spectra = values.get("spectra", {})
    for name, group in spectra.items() if isinstance(spectra, dict) else ():
        if name not in preset.spectra or not isinstance(group, dict) or not set(group) <= set(_OF_SPECTRA):
            raise UserError(f"{path}: of {name} it may have {', '.join(_OF_SPECTRA)} only, of a known spectrum.", hint)
