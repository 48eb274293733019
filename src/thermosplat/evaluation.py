"""A model against the views it was not trained on: numbers per view and their means, and pictures to look at."""

import csv
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from thermosplat.checkpoint import write_atomically
from thermosplat.comparison_strips import Comparison, comparison_strip
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors, frame_tensors
from thermosplat.image_display import encode_png, rgb_bytes, thermal_bytes
from thermosplat.metrics import mae_celsius, psnr, ssim, thermal_intensity
from thermosplat.model import SceneModel
from thermosplat.radiometry import ThermalScale

Modality = Literal["rgb", "thermal"]
Lpips = Callable[[Tensor, Tensor], float | None]

COLUMNS = {"rgb": ("psnr", "ssim", "lpips"), "thermal": ("psnr", "ssim", "lpips", "mae_celsius")}
LARGEST_ERROR = 0.25  # of the value range 0 to 1, at the bright end of error maps
LARGEST_ERROR_CELSIUS = 0.1  # of the temperature range, where there are degrees


@torch.no_grad()
def evaluate(
    model: SceneModel,
    capture: Capture,
    *,
    sh_degree: int,
    device: torch.device | str,
    lpips: Lpips | None = None,
    strips_dir: Path | None = None,
    csv_path: Path | None = None,
) -> dict[str, Any]:
    """Render every held-out view, clamped to [0, 1], and compare it with its image.

    Args:
        model: The scene.
        capture: Its capture; ``capture.test`` is rendered.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
        lpips: LPIPS of two images [H, W, 3] in [0, 1]; None leaves the LPIPS numbers null.
        strips_dir: Existing folder for one PNG a frame: ground truth, render and error of its modalities.
        csv_path: File for the numbers of every view.

    Returns:
        ``{"rgb": {"psnr", "ssim", "lpips"} | None, "thermal": {the same, "mae_celsius"} | None, "num_gaussians"}``: PSNR
        [dB], mean absolute error [°C], each the mean over the views that have it, None where none has. A modality
        without held-out views, or not modelled, is None as a whole.
    """
    scale = capture.thermal_scale
    rows: list[dict[str, Any]] = []
    for frame in capture.test:
        tensors = frame_tensors(frame, scale, device)
        rendered = model.render(tensors.rgb, tensors.thermal, sh_degree=sh_degree)
        images: dict[Modality, Tensor | None] = {"rgb": rendered.rgb, "thermal": rendered.thermal}
        comparisons = []
        for modality, image in images.items():
            view = _view(tensors, modality)
            if image is None or view is None or view.image is None:
                continue
            image = image.clamp(0.0, 1.0)
            numbers = _numbers(modality, image, view.image, view, scale, lpips)
            rows.append({"frame": frame.name, "modality": modality, **numbers})
            if strips_dir is not None:
                comparisons.append(_comparison(modality, image, view.image, view, scale, numbers["psnr"]))
        if strips_dir is not None and comparisons:
            png = encode_png(comparison_strip(comparisons))
            write_atomically(strips_dir / f"{_file_stem(frame.name)}.png", partial(Path.write_bytes, data=png))
    if csv_path is not None:
        _write_csv(csv_path, rows)
    return {
        "rgb": _means(rows, "rgb"),
        "thermal": _means(rows, "thermal"),
        "num_gaussians": model.num_gaussians,
    }


def _view(tensors: FrameTensors, modality: Modality) -> ViewTensors | None:
    return tensors.rgb if modality == "rgb" else tensors.thermal


def _numbers(
    modality: Modality,
    image: Tensor,
    target: Tensor,
    view: ViewTensors,
    scale: ThermalScale | None,
    lpips: Lpips | None,
) -> dict[str, float | None]:
    numbers: dict[str, float | None] = {
        "psnr": psnr(image, target),
        "ssim": ssim(image, target),
        "lpips": None if lpips is None else lpips(image, target),
    }
    if modality == "thermal":
        has_degrees = view.celsius is not None and scale is not None
        numbers["mae_celsius"] = (
            mae_celsius(thermal_intensity(image, scale), view.celsius, scale) if has_degrees else None
        )
    return {name: _finite(number) for name, number in numbers.items()}


def _finite(number: float | None) -> float | None:
    """The number, or None in place of an infinite PSNR (equal images), which would swallow the mean."""
    return number if number is not None and math.isfinite(number) else None


def _comparison(
    modality: Modality,
    image: Tensor,
    target: Tensor,
    view: ViewTensors,
    scale: ThermalScale | None,
    decibels: float | None,
) -> Comparison:
    render, truth = image.cpu().numpy(), target.cpu().numpy()
    score = "exact" if decibels is None else f"{decibels:.2f} dB"
    error = np.abs(render - truth).mean(axis=-1)
    if modality == "rgb" or scale is None:
        return Comparison("RGB", score, rgb_bytes(truth), rgb_bytes(render), error, LARGEST_ERROR)
    shown = thermal_bytes(truth, scale), thermal_bytes(render, scale)
    if view.celsius is None or scale.range_celsius is None:
        return Comparison("thermal", score, *shown, error, LARGEST_ERROR)
    low, high = scale.range_celsius
    celsius = scale.celsius(thermal_intensity(image, scale).numpy())
    degrees = np.nan_to_num(np.abs(celsius - view.celsius.cpu().numpy()))  # unmeasured pixels show as no error
    return Comparison("thermal", score, *shown, degrees, LARGEST_ERROR_CELSIUS * (high - low), unit="C")


def _means(rows: list[dict[str, Any]], modality: Modality) -> dict[str, float | None] | None:
    of_modality = [row for row in rows if row["modality"] == modality]
    if not of_modality:
        return None
    means: dict[str, float | None] = {}
    for column in COLUMNS[modality]:
        values = [row[column] for row in of_modality if row[column] is not None]
        means[column] = float(np.mean(values)) if values else None
    return means


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, ["frame", "modality", *COLUMNS["thermal"]])
            writer.writeheader()
            writer.writerows(rows)  # None becomes an empty cell

    write_atomically(path, write)


def _file_stem(frame_name: str) -> str:
    return frame_name.replace("/", "_")
