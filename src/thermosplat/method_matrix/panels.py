"""The pictures that a cell keeps for the comparison sheets: truth, render and error of a few held-out frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from thermosplat.datasets.capture import Capture, Frame, Modality
from thermosplat.errors import UserError
from thermosplat.evaluation import file_stem, frame_comparisons
from thermosplat.image_display import Image8, error_bytes, read_png, write_png
from thermosplat.method_matrix.cell_result import read_json, write_json
from thermosplat.model import SceneModel

FOLDER = "panels"
INDEX = "panels.json"
FRAMES = 3
"""Held-out frames that are kept: the first, one in the middle, the last."""


@dataclass(frozen=True)
class Panels:
    """Pictures of one modality of one frame, 8-bit RGB [H, W, 3]."""

    truth: Image8
    """Ground truth."""
    render: Image8
    """Render."""
    error: Image8
    """Error map."""
    score: str
    """The render's number, e.g. "24.31 dB"."""
    palette_end: str
    """What the bright end of the error map stands for."""


def shown_frames(frames: Sequence[Frame]) -> list[Frame]:
    """The frames that are kept, the same ones for every method."""
    if len(frames) <= FRAMES:
        return list(frames)
    return [frames[round(index * (len(frames) - 1) / (FRAMES - 1))] for index in range(FRAMES)]


def write_panels(
    folder: Path, model: SceneModel, capture: Capture, *, sh_degree: int, device: torch.device | str
) -> None:
    """Render the kept frames and write their pictures.

    Args:
        folder: The cell's run folder.
        model: The scene.
        capture: Its capture.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
    """
    index: list[dict[str, Any]] = []
    for frame in shown_frames(capture.test):
        comparisons = frame_comparisons(model, frame, capture.thermal_scale, sh_degree=sh_degree, device=device)
        for modality, comparison in comparisons.items():
            stem = f"{file_stem(frame.name)}_{modality}"
            write_png(folder / FOLDER / f"{stem}_truth.png", comparison.truth)
            write_png(folder / FOLDER / f"{stem}_render.png", comparison.render)
            error = error_bytes(comparison.error, comparison.largest_error)
            write_png(folder / FOLDER / f"{stem}_error.png", error)
            end = f"{comparison.largest_error:.2g} {comparison.unit}".rstrip()
            index.append(
                {"frame": frame.name, "modality": modality, "score": comparison.score, "palette_end": end, "stem": stem}
            )
    write_json(folder / FOLDER / INDEX, {"panels": index})


def read_panels(folder: Path) -> dict[tuple[str, Modality], Panels]:
    """The pictures of a cell by frame and modality; none where it has none.

    Args:
        folder: The cell's run folder.

    Raises:
        UserError: A picture is missing or damaged.
    """
    path = folder / FOLDER / INDEX
    if not path.is_file():
        return {}
    panels: dict[tuple[str, Modality], Panels] = {}
    for entry in read_json(path)["panels"]:
        truth, render, error = (
            _read(folder / FOLDER / f"{entry['stem']}_{kind}.png") for kind in ("truth", "render", "error")
        )
        key = entry["frame"], entry["modality"]
        panels[key] = Panels(truth, render, error, entry["score"], entry["palette_end"])
    return panels


def _read(path: Path) -> Image8:
    image = read_png(path)
    if image is None:
        raise UserError(
            f"{path} is missing or damaged.", f"Delete the folder {path.parent}: the sheets then leave it out."
        )
    return image
