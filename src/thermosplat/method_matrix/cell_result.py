"""What a finished cell says of itself: cell.json in its run folder."""

import json
from dataclasses import MISSING, asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermosplat.config import TrainConfig
from thermosplat.config.renamed import with_todays_names
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import Cell, settings
from thermosplat.runs.atomic_writes import write_text

if TYPE_CHECKING:
    from thermosplat.evaluation.labelled_regions import Regions

FILE_NAME = "cell.json"
FORMAT = 2
OLD_FORMAT = 1
"""Of version 0.1, which knew two spectra by name."""

Metrics = dict[str, float | None]


@dataclass(frozen=True)
class CellResult:
    """Quality and cost of one cell."""

    scene: str
    """The scene's name."""
    method: str
    """The method's name."""
    seed: int
    """Seed of the training."""
    steps: int
    """Training steps."""
    spectra: dict[str, Metrics | None]
    """By spectrum "psnr" [dB], "ssim", "lpips" and, of measured values, "mae_<unit>", means over the held-out views."""
    num_gaussians: int
    """Gaussians in all sets."""
    model_bytes: int
    """All parameters, Gaussians' and decoders', as a checkpoint stores them: see ``SceneModel.num_bytes``."""
    train_minutes: float
    """Time in training steps [min]."""
    peak_memory_bytes: int | None
    """Most GPU memory that the last sitting of the training had allocated; None on the CPU."""
    frames_per_second: float
    """Held-out frames rendered a second, all modelled spectra of a frame together."""
    device: str
    """What it was trained and timed on."""
    lpips_net: str | None
    """Backbone and input scaling of LPIPS; None where it was not measured."""
    settings: dict[str, Any]
    """What was computed (``cells.settings``)."""
    per_view: list[dict[str, Any]]
    """Metrics of every held-out view: "frame", "spectrum" and the metrics."""
    regions: "Regions | None" = None
    """Errors by region (``labelled_regions.region_errors``); None where the capture has no ground truth."""

    @property
    def cell(self) -> Cell:
        """Which cell this is."""
        return Cell(self.scene, self.method, self.seed)


def write_cell(folder: Path, result: CellResult) -> None:
    """Write a cell's cell.json, atomically."""
    write_json(folder / FILE_NAME, {"format": FORMAT, **asdict(result)})


def read_cell(path: Path) -> CellResult:
    """Read a cell.json, and the regions.json beside it, which thermosplat-eval may have added later.

    Raises:
        UserError: It is damaged or of another version.
    """
    result = result_from(read_json(path), path)
    return result if result.regions is not None else replace(result, regions=read_regions(path.parent, result.steps))


def read_regions(folder: Path, steps: int) -> "Regions | None":
    """The errors by region in a cell's run folder; None where there are none, or of a model after other steps.

    Raises:
        UserError: The file is damaged.
    """
    path = folder / "regions.json"
    if not path.is_file():
        return None
    values = read_json(path)
    if not isinstance(values, dict) or not {"steps", "regions"} <= values.keys():
        raise UserError(f"{path} holds no errors by region.", "Delete it, or make it again with thermosplat-eval.")
    regions: "Regions" = values["regions"]
    return regions if values["steps"] == steps else None


def result_from(values: Any, path: Path) -> CellResult:
    """A cell's result from its JSON object.

    Args:
        values: The object.
        path: The file it comes from, for the error message.

    Raises:
        UserError: Something is missing, or it is of another version.
    """
    if isinstance(values, dict) and values.get("format") == OLD_FORMAT:
        values = _as_today(values, path)
    names = {field.name for field in fields(CellResult)}
    required = {field.name for field in fields(CellResult) if field.default is MISSING}
    if not isinstance(values, dict) or values.get("format") != FORMAT or not required <= values.keys():
        raise UserError(
            f"{path} does not hold a cell's result as this version writes it.",
            "Delete it; thermosplat-benchmark then makes that cell again.",
        )
    result = CellResult(**{name: values[name] for name in names & values.keys()})
    return replace(result, settings=_settings_of_today(result.settings, path))


def _settings_of_today(made_with: dict[str, Any], path: Path) -> dict[str, Any]:
    try:
        return with_todays_names(made_with, source=str(path))
    except UserError as error:
        raise UserError(error.message, "Delete that file; thermosplat-benchmark then makes the cell again.") from error


def _as_today(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """A cell of format 1 in today's format."""
    spectra = {name: values[name] for name in ("rgb", "thermal") if values.get(name) is not None}
    per_view = [
        {"spectrum" if key == "modality" else key: value for key, value in row.items()}
        for row in values.get("per_view", [])
    ]
    # Settings that 0.1 did not have get their defaults, so that its matrices can be gone on with.
    made_with = _settings_of_today(values.get("settings", {}), path)
    steps = made_with.get("max_steps")
    defaults = TrainConfig(max_steps=steps) if isinstance(steps, int) else TrainConfig()
    made_with = _filled(settings(defaults), made_with)
    return values | {"format": FORMAT, "spectra": spectra, "per_view": per_view, "settings": made_with}


def _filled(defaults: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Nested values, with those of ``defaults`` where there are none."""
    filled = defaults | values
    for name, default in defaults.items():
        if isinstance(default, dict) and isinstance(filled[name], dict):
            filled[name] = _filled(default, filled[name])
    return filled


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: It cannot be read as JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: {error}.", "Delete it, or restore it.") from error


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")
