"""From what a user names to a scene: a run, a checkpoint or a PLY file."""

import contextlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import torch

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import LoadedRun, load_run, load_run_of_checkpoint
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.regular_files import read_regular
from thermosplat.runs.devices import choose_device
from thermosplat.spectra import CELSIUS
from thermosplat.thermography.comparison_file import read_comparison
from thermosplat.thermography.measurements_file import FOLDER
from thermosplat.viewer.splat_file import open_splats
from thermosplat.viewer.viewed_scene import EarlierDate, ViewedScene

OTHER_FORMATS = (".splat", ".ksplat", ".spz", ".sog", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")
"""Endings of Gaussians' other files."""


def open_scene(
    named: str,
    *,
    step: int | None = None,
    data: str | None = None,
    device: str = "auto",
    settings: TemperatureSettings | None = None,
    scale_of: Callable[[Capture | None], float | None] = lambda capture: None,
    query: str | None = None,
    compare: str | None = None,
) -> tuple[ViewedScene, Path, list[str]]:
    """What a user wants to look at.

    Args:
        named: A result folder, a checkpoint (.pt) or a PLY file.
        step: Which checkpoint of a run; None: the last.
        data: Where the capture lies now; None: where it lay.
        device: As ``--device``.
        scale_of: Length of a world unit of a capture [m], where it is known.
        query: File (.npy) with a vector that features are compared with.
        compare: Folder of thermosplat-compare, whose first date is shown beside the run.

    Returns:
        The scene; the folder for measurements; lines to tell the user.

    Raises:
        UserError: There is no such thing, or it cannot be read.
    """
    path = Path(named).expanduser()
    settings = settings or TemperatureSettings()
    if path.suffix.lower() == ".ply":
        if compare is not None:
            raise UserError(f"{path} is no run, and --compare shows a run beside an earlier one.", "Give the run.")
        if settings.any_given or query is not None:
            what = "no features that --query could be compared with" if query else "no temperature to be recalculated"
            raise UserError(f"{path} has colours alone, {what}.", "Give the run.")
        splats, notes = open_splats(path, choose_device(device))
        return splats, path.parent / f"{path.stem}_{FOLDER}", notes
    if path.suffix.lower() in OTHER_FORMATS:
        raise UserError(
            f"{path} is a file for other programs, which thermosplat-view does not read.",
            "Give the RUN itself, or a PLY of it: thermosplat-export RUN --format ply",
        )
    is_checkpoint = path.suffix == ".pt" and not path.is_dir()
    if is_checkpoint and step is not None:
        raise UserError(f"{path} is one checkpoint, and --step chooses one of a run.", "Give one of the two.")
    run = load_run_of_checkpoint(path, device=device) if is_checkpoint else load_run(named, step=step, device=device)
    capture, more = _photographs(run, data)
    scales = dict(run.scales)
    name = run.directory.path.resolve().name
    temperatures = None
    if settings.any_given or any(scale.measured_unit == CELSIUS for scale in scales.values()):
        temperatures = run.temperatures(settings, capture=capture, metres_per_unit=scale_of(capture))
        more += temperatures.notes
    if query is not None:
        _ask(run, Path(query).expanduser())
    title = f"{name}, step {run.step:,}"
    sure = {} if capture is None else run.certainties(capture)
    scene = ViewedScene(title, run.model, run.sh_degree, scales, run.device, capture, temperatures, sure)
    if compare is not None:
        scene.earlier = _earlier(Path(compare).expanduser(), run, device)
    return scene, run.directory.path / FOLDER, [*run.notes, *more]


def _earlier(folder: Path, run: LoadedRun, device: str) -> EarlierDate:
    """The first date of a comparison beside a run."""
    known = read_comparison(folder)
    date, first = known.of(run.directory.path), load_run(str(known.run), device=device)
    if not all(known.spectrum in one.scales for one in (run, first)):
        raise UserError(f"{folder} compares {known.spectrum}, which the runs do not have.", "Compare them again.")
    scene = ViewedScene(known.first, first.model, first.sh_degree, dict(first.scales), first.device)
    with contextlib.suppress(UserError):  # the capture only says between which values pictures are coloured
        scene.capture = first.capture(None)
    frame = MapFrame.of_similarity(date.to_first).inverse
    return EarlierDate(scene, frame, known.spectrum, date.shift, date.span)


def _ask(run: LoadedRun, path: Path) -> None:
    """Compare the features of a run with the vector of a file."""
    try:
        query = torch.from_numpy(np.load(BytesIO(read_regular(path)), allow_pickle=False).astype(np.float32).squeeze())
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise UserError(f"The query {path} cannot be read.", "Expected is a vector in a .npy file.") from error
    if not any([run.model.formations[name].ask(query) for name in run.model.spectra]):
        raise UserError(f"{run.directory.path} has no features that --query could be compared with.")


def _photographs(run: LoadedRun, data: str | None) -> tuple[Capture | None, list[str]]:
    """The run's capture; without it everything but the photographs can be looked at."""
    try:
        capture = run.capture(data)
    except UserError as error:
        if data is not None:
            raise
        return None, [f"No photographs are shown: {error.message} {error.hint}"]
    return capture, list(capture.notes)
