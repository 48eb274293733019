"""The pictures that a cell keeps for the comparison sheets: truth, render and error of a few held-out frames.

Where the capture brings ground truth, also the true and the rendered depth of each spectrum.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import without_pixels
from thermosplat.datasets.ground_truth import GroundTruth, read_ground_truth
from thermosplat.errors import UserError
from thermosplat.evaluation.held_out import file_stem, frame_comparisons
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.method_matrix.cell_result import read_json, write_json
from thermosplat.pictures.image_display import Image8, depth_bytes, error_bytes, read_png, write_png
from thermosplat.runs.atomic_writes import plain_folder
from thermosplat.scene.model import SceneModel
from thermosplat.thermography.display_range import display_range

FOLDER = "panels"
INDEX = "panels.json"
FRAMES = 3
"""Held-out frames that are kept: the first, one in the middle, the last."""


@dataclass(frozen=True)
class Panels:
    """Pictures of one spectrum of one frame, 8-bit RGB [H, W, 3]."""

    truth: Image8
    render: Image8
    error: Image8
    score: str
    """The render's number, e.g. "24.31 dB"."""
    palette_end: str
    """What the bright end of the error map stands for."""
    true_depth: Image8 | None = None
    """Depth of the surface that the spectrum sees; None without ground truth."""
    depth: Image8 | None = None
    depth_range: str = ""
    """What the ends of the depths' palette stand for, e.g. "0.8 to 4.4"."""


@torch.no_grad()
def write_panels(folder: Path, model: SceneModel, capture: Capture, *, sh_degree: int) -> None:
    """Render the kept frames and write their pictures."""
    index: list[dict[str, Any]] = []
    pictures = plain_folder(folder, FOLDER)
    for frame in evenly_chosen(capture.test, FRAMES):
        truth = read_ground_truth(capture, frame)
        ranges = {name: display_range(capture, name) for name in model.spectra}
        comparisons = frame_comparisons(model, frame, capture.scales, sh_degree=sh_degree, ranges=ranges)
        for spectrum, comparison in comparisons.items():
            stem = f"{file_stem(frame.name)}_{spectrum}"
            write_png(pictures / f"{stem}_truth.png", comparison.truth)
            write_png(pictures / f"{stem}_render.png", comparison.render)
            error = error_bytes(comparison.error, comparison.largest_error)
            write_png(pictures / f"{stem}_error.png", error)
            end = f"{comparison.largest_error:.2g} {comparison.unit}".rstrip()
            entry = {
                **{"frame": frame.name, "spectrum": spectrum, "score": comparison.score, "palette_end": end},
                **{"stem": stem, "depth_range": ""},
            }
            span = None if truth is None or spectrum not in truth.depths else _depth_span(truth)
            if truth is not None and span is not None:
                camera = without_pixels(frame.views[spectrum], model.device)
                depth = model.render_depth(spectrum, camera).cpu().numpy()
                write_png(pictures / f"{stem}_true_depth.png", depth_bytes(truth.depths[spectrum], *span))
                write_png(pictures / f"{stem}_depth.png", depth_bytes(depth, *span))
                entry["depth_range"] = f"{span[0]:.2g} to {span[1]:.2g}"
            index.append(entry)
    write_json(pictures / INDEX, {"panels": index})


def read_panels(folder: Path) -> dict[tuple[str, str], Panels]:
    """The pictures of a cell by frame and spectrum; none where it has none.

    Raises:
        UserError: A picture is missing or damaged.
    """
    path = folder / FOLDER / INDEX
    if not path.is_file():
        return {}
    panels: dict[tuple[str, str], Panels] = {}
    for entry in read_json(path)["panels"]:
        truth, render, error = (
            _read(folder / FOLDER / f"{entry['stem']}_{kind}.png") for kind in ("truth", "render", "error")
        )
        key = entry["frame"], entry["spectrum"]
        panels[key] = Panels(truth, render, error, entry["score"], entry["palette_end"])
        if entry.get("depth_range"):
            panels[key] = replace(
                panels[key],
                true_depth=_read(folder / FOLDER / f"{entry['stem']}_true_depth.png"),
                depth=_read(folder / FOLDER / f"{entry['stem']}_depth.png"),
                depth_range=entry["depth_range"],
            )
    return panels


def _depth_span(truth: GroundTruth) -> tuple[float, float] | None:
    """Nearest and farthest true depth of all spectra; None where nothing, or only a single depth, is seen."""
    depths = np.concatenate([depth[depth > 0] for depth in truth.depths.values()])
    return (float(depths.min()), float(depths.max())) if depths.size and depths.min() < depths.max() else None


def _read(path: Path) -> Image8:
    image = read_png(path)
    if image is None:
        raise UserError(
            f"{path} is missing or damaged.", f"Delete the folder {path.parent}: the sheets then leave it out."
        )
    return image
