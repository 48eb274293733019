"""A model against the views it was not trained on: numbers per view and their means, and pictures to look at."""

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from thermosplat.background_writes import background_writes
from thermosplat.checkpoint import write_atomically
from thermosplat.comparison_strips import Comparison, comparison_strip
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.image_display import rgb_bytes, thermal_bytes, write_png
from thermosplat.metrics import mae_celsius, psnr, ssim
from thermosplat.model import SceneModel
from thermosplat.radiometry import ThermalScale
from thermosplat.thermal_intensity import thermal_intensity

Modality = Literal["rgb", "thermal"]
Lpips = Callable[[Tensor, Tensor], float | None]

COLUMNS = {"rgb": ("psnr", "ssim", "lpips"), "thermal": ("psnr", "ssim", "lpips", "mae_celsius")}
LARGEST_ERROR = 0.25  # of the value range 0 to 1, at the bright end of error maps
LARGEST_ERROR_CELSIUS = 0.1  # of the temperature range, where there are degrees


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One modality of one frame: its render, clamped to [0, 1], and what it should have been."""

    modality: Modality
    camera: ViewTensors
    """From where it was rendered."""
    image: Tensor
    """[H, W, C]."""
    target: Tensor
    """[H, W, C]."""
    scale: ThermalScale | None
    """Thermal only."""
    celsius: Tensor | None
    """[H, W]; thermal only, where there are degrees."""

    @cached_property
    def intensity(self) -> Tensor:
        """Scalar intensity of a thermal render in [0, 1], [H, W]; to invert a palette takes a while."""
        if self.scale is None:
            raise ValueError("Only thermal images have an intensity.")
        return thermal_intensity(self.image, self.scale)


def rendered_views(
    model: SceneModel, frame: Frame, scale: ThermalScale | None, sh_degree: int, device: torch.device | str
) -> Iterator[RenderedView]:
    """Render a frame; yields its modalities that are both modelled and photographed.

    Args:
        model: The scene.
        frame: The frame.
        scale: The capture's thermal scale; None where there is no thermal view.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
    """
    # without the scale, so that no palette is inverted for the photographs: only renders are asked for intensities
    rgb, thermal = (None if view is None else view_tensors(view, None, device) for view in (frame.rgb, frame.thermal))
    rendered = model.render(rgb, thermal, sh_degree=sh_degree)
    views: tuple[tuple[Modality, Tensor | None, ViewTensors | None], ...] = (
        ("rgb", rendered.rgb, rgb),
        ("thermal", rendered.thermal, thermal),
    )
    for modality, image, view in views:
        if image is not None and view is not None and view.image is not None:
            thermal_scale = scale if modality == "thermal" else None
            has_degrees = thermal_scale is not None and thermal_scale.range_celsius is not None
            yield RenderedView(
                modality, view, image.clamp(0, 1), view.image, thermal_scale, view.celsius if has_degrees else None
            )


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
        strips_dir: Folder for one PNG a frame: ground truth, render and error of its modalities.
        csv_path: File for the numbers of every view.

    Returns:
        ``{"rgb": {"psnr", "ssim", "lpips"} | None, "thermal": {the same, "mae_celsius"} | None, "num_gaussians"}``,
        with PSNR in dB and the mean absolute error in °C, each the mean over the views that have it, None where none
        has. A modality without held-out views, or not modelled, is None as a whole.
    """
    scale = capture.thermal_scale
    rows: list[dict[str, Any]] = []
    with background_writes() as write:
        for frame in capture.test:
            results = list(rendered_views(model, frame, scale, sh_degree, device))
            numbers = [_numbers(result, lpips) for result in results]
            rows += [{"frame": frame.name, "modality": r.modality, **values} for r, values in zip(results, numbers)]
            if strips_dir is not None and results:
                comparisons = [_comparison(result, values["psnr"]) for result, values in zip(results, numbers)]
                strip = strips_dir / f"{file_stem(frame.name)}.png"
                write(partial(write_png, strip, comparison_strip(comparisons)))
    if csv_path is not None:
        _write_csv(csv_path, rows)
    return {
        "rgb": _means(rows, "rgb"),
        "thermal": _means(rows, "thermal"),
        "num_gaussians": model.num_gaussians,
    }


@torch.no_grad()
def frame_comparisons(
    model: SceneModel, frame: Frame, scale: ThermalScale | None, *, sh_degree: int, device: torch.device | str
) -> dict[Modality, Comparison]:
    """Ground truth, render and error of one frame, by modality.

    Args:
        model: The scene.
        frame: The frame.
        scale: The capture's thermal scale; None where there is no thermal view.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
    """
    return {
        result.modality: _comparison(result, _finite(psnr(result.image, result.target)))
        for result in rendered_views(model, frame, scale, sh_degree, device)
    }


def file_stem(frame_name: str) -> str:
    """A frame's name as part of a file name."""
    return frame_name.replace("/", "_")


def _numbers(result: RenderedView, lpips: Lpips | None) -> dict[str, float | None]:
    numbers: dict[str, float | None] = {
        "psnr": psnr(result.image, result.target),
        "ssim": ssim(result.image, result.target),
        "lpips": None if lpips is None else lpips(result.image, result.target),
    }
    if result.scale is not None:
        numbers["mae_celsius"] = None
        if result.celsius is not None:
            numbers["mae_celsius"] = mae_celsius(result.intensity, result.celsius, result.scale)
    return {name: _finite(number) for name, number in numbers.items()}


def _finite(number: float | None) -> float | None:
    """The number, or None in place of an infinite PSNR (equal images), which would swallow the mean."""
    return number if number is not None and math.isfinite(number) else None


def _comparison(result: RenderedView, decibels: float | None) -> Comparison:
    render, truth = result.image.cpu().numpy(), result.target.cpu().numpy()
    error = np.abs(render - truth).mean(axis=-1)
    without = "not finite" if np.isnan(error).any() else "exact"
    score = without if decibels is None else f"{decibels:.2f} dB"
    if result.scale is None:
        return Comparison("RGB", score, rgb_bytes(truth), rgb_bytes(render), error, LARGEST_ERROR)
    shown = thermal_bytes(truth, result.scale), thermal_bytes(render, result.scale)
    if result.celsius is None or result.scale.range_celsius is None:
        return Comparison("thermal", score, *shown, error, LARGEST_ERROR)
    low, high = result.scale.range_celsius
    degrees = (result.scale.celsius(result.intensity) - result.celsius).abs().nan_to_num()  # unmeasured: no error
    return Comparison("thermal", score, *shown, degrees.cpu().numpy(), LARGEST_ERROR_CELSIUS * (high - low), unit="C")


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
