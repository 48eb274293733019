"""What a finished cell says of itself: cell.json in its run folder."""

import json
from dataclasses import MISSING, asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermosplat.config.gone_settings import without_gone_settings
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import Cell
from thermosplat.runs.atomic_writes import write_text

if TYPE_CHECKING:
    from thermosplat.evaluation.labelled_regions import Regions

FILE_NAME = "cell.json"
FORMAT = 2
Metrics = dict[str, float | None]


@dataclass(frozen=True)
class CellResult:
    """Quality and cost of one cell."""

    scene: str
    method: str
    seed: int
    steps: int
    spectra: dict[str, Metrics | None]
    """By spectrum "psnr" [dB], "ssim", "lpips" and, of measured values, "mae_<unit>", means over the held-out views."""
    num_gaussians: int
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

    Raises:
        UserError: Something is missing, or it is of another version.
    """
    names = {field.name for field in fields(CellResult)}
    required = {field.name for field in fields(CellResult) if field.default is MISSING}
    if not isinstance(values, dict) or values.get("format") != FORMAT or not required <= values.keys():
        raise UserError(
            f"{path} does not hold a cell's result as this version writes it.",
            "Delete it; thermosplat-benchmark then makes that cell again.",
        )
    result = CellResult(**{name: values[name] for name in names & values.keys()})
    try:
        return replace(result, settings=without_gone_settings(result.settings, source=str(path)))
    except UserError as error:
        raise UserError(error.message, "Delete that file; thermosplat-benchmark then makes the cell again.") from error


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
