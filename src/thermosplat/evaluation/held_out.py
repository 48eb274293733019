"""A model against the views it was not trained on: numbers per view and their means, and pictures to look at."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.datasets.read_ahead import read_ahead
from thermosplat.evaluation.class_values import ClassValues
from thermosplat.image_quality.metrics import psnr, right_outside, ssim
from thermosplat.pictures.comparison_strips import Comparison, comparison_strip
from thermosplat.pictures.image_display import spectrum_bytes, write_png
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.background_writes import background_writes
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import BIAS, MAE, label, unit_label
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.display_range import display_range
from thermosplat.thermography.scene_temperatures import SceneTemperatures, Surroundings

Lpips = Callable[[Tensor, Tensor], float | None]

COLUMNS = ("psnr", "ssim", "lpips")
"""Metrics of every spectrum; measured ones have "mae_<unit>" as well, and a kind of formation may have its own."""
LARGEST_ERROR = 0.25  # of the value range 0 to 1, at the bright end of error maps
LARGEST_MEASURED_ERROR = 0.1  # of the range of values, where they are measured


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One spectrum of one frame: its render, clamped to [0, 1], and what it should have been."""

    spectrum: str
    camera: ViewTensors
    image: Tensor
    """[H, W, C]."""
    target: Tensor
    """[H, W, C]."""
    scale: PixelScale
    values: Tensor | None
    """[H, W]; where there are measured values."""
    formation: Formation | None = None
    """How it was formed; says what else it is judged by."""
    temperatures: SceneTemperatures | None = None
    """How values are recalculated; None: they are not."""

    @property
    def mask(self) -> Tensor | None:
        """bool [H, W], which pixels count; None: all."""
        return self.camera.mask

    @property
    def counted(self) -> Tensor:
        """The image with its target in place of pixels that do not count, [H, W, C]."""
        return right_outside(self.image, self.target, self.mask)

    @cached_property
    def intensity(self) -> Tensor:
        """Scalar intensity of the render in [0, 1], [H, W], of an image that is no photograph.

        To invert a palette takes a while.
        """
        return pixel_intensity(self.image, self.scale)

    @cached_property
    def measured(self) -> Tensor | None:
        """Measured values of the render, recalculated where they are, [H, W]; None of a spectrum without a unit."""
        return None if self.scale.measured_unit is None else self._recalculated(self.scale.value(self.intensity))

    @cached_property
    def missed(self) -> Tensor | None:
        """Measured values of the render minus those of the photograph, both recalculated where they are: float64
        [H, W], NaN where nothing was measured; None of a spectrum without values."""
        if self.values is None or self.measured is None:
            return None
        expected = self._recalculated(self.values)
        return (self.measured.double() - expected.double()).where(self.values.isfinite(), torch.nan)

    @cached_property
    def _around(self) -> Surroundings | None:
        return None if self.temperatures is None else self.temperatures.surroundings(self.spectrum, self.camera)

    def _recalculated(self, values: Tensor) -> Tensor:
        if self.temperatures is None:
            return values
        return self.temperatures.recalculated(self.spectrum, values, self._around).values


def rendered_views(
    model: SceneModel,
    frame: Frame,
    scales: Mapping[str, PixelScale],
    sh_degree: int,
    temperatures: SceneTemperatures | None = None,
) -> Iterator[RenderedView]:
    """Render a frame; yields its spectra that are both modelled and photographed.

    Args:
        temperatures: How measured values are recalculated; None: they are not.
    """
    # without the scale, so that no palette is inverted for the photographs: only renders are asked for intensities
    modelled = {name: view for name, view in frame.views.items() if name in model.spectra}
    views = {name: view_tensors(view, None, model.device) for name, view in modelled.items()}
    groups = [[name for name in group if name in views] for group in frame.shared_cameras]
    rendered = model.render(views, sh_degree=sh_degree, shared_cameras=groups)
    for name, image in sorted(rendered.images.items(), key=lambda item: list(model.spectra).index(item[0])):
        view = views[name]
        if view.image is not None:
            measured = scales[name].measured_unit is not None
            values = view.values if measured else None
            formation = rendered.formations.get(name)
            image = image.clamp(0, 1)
            yield RenderedView(name, view, image, view.image, scales[name], values, formation, temperatures)


@torch.no_grad()
def evaluate(
    model: SceneModel,
    capture: Capture,
    *,
    sh_degree: int,
    lpips: Lpips | None = None,
    strips_dir: Path | None = None,
    csv_path: Path | None = None,
    temperatures: SceneTemperatures | None = None,
) -> dict[str, Any]:
    """Render every held-out view, clamped to [0, 1], and compare it with its image.

    Args:
        capture: Its capture; ``capture.test`` is rendered.
        lpips: LPIPS of two images [H, W, 3] in [0, 1]; None leaves the LPIPS numbers null.
        strips_dir: Folder for one PNG per frame: ground truth, render and error of its spectra.
        temperatures: How temperatures are recalculated before they are compared; None: they are not.

    Returns:
        By spectrum of the model ``{"psnr" [dB], "ssim", "lpips", "mae_<unit>", "bias_<unit>"}`` and
        ``Formation.scores``, each the mean over the views that have it, None where none has; None as a whole for a
        spectrum without held-out views. The mean absolute error and the bias, that of render minus image, are there
        where its values are measured. "spectra" lists their names; "num_gaussians" counts the Gaussians. Where a
        spectrum tells classes and another one measures, "classes" has ``ClassValues.numbers``.
    """
    rows: list[dict[str, Any]] = []
    by_class = ClassValues()
    ranges = {} if strips_dir is None else {name: display_range(capture, name) for name in model.spectra}
    with background_writes() as write:
        for frame in read_ahead(capture.test):
            results = list(rendered_views(model, frame, capture.scales, sh_degree, temperatures))
            numbers = [_numbers(result, lpips) for result in results]
            by_class.add(results)
            rows += [{"frame": frame.name, "spectrum": r.spectrum, **values} for r, values in zip(results, numbers)]
            if strips_dir is not None and results:
                comparisons = [
                    _comparison(result, values["psnr"], ranges.get(result.spectrum))
                    for result, values in zip(results, numbers)
                ]
                strip = strips_dir / f"{file_stem(frame.name)}.png"
                write(partial(write_png, strip, comparison_strip(comparisons)))
    if csv_path is not None:
        _write_csv(csv_path, rows)
    means = {name: _means(rows, name) for name in model.spectra}
    counted = {"spectra": list(model.spectra), "num_gaussians": model.num_gaussians}
    return {**means, **counted, **({"classes": classes} if (classes := by_class.numbers()) else {})}


@torch.no_grad()
def frame_comparisons(
    model: SceneModel,
    frame: Frame,
    scales: Mapping[str, PixelScale],
    *,
    sh_degree: int,
    ranges: Mapping[str, tuple[float, float] | None] | None = None,
) -> dict[str, Comparison]:
    """Ground truth, render and error of one frame, by spectrum.

    Args:
        ranges: Values at the palettes' ends by spectrum (``display_range``); None: those of the scales.
    """
    shown = ranges or {}
    return {
        result.spectrum: _comparison(
            result, _finite(psnr(result.image, result.target, result.mask)), shown.get(result.spectrum)
        )
        for result in rendered_views(model, frame, scales, sh_degree)
    }


def file_stem(frame_name: str) -> str:
    """A frame's name as part of a file name."""
    return frame_name.replace("/", "_")


def _numbers(result: RenderedView, lpips: Lpips | None) -> dict[str, float | None]:
    numbers: dict[str, float | None] = {
        "psnr": psnr(result.image, result.target, result.mask),
        "ssim": ssim(result.image, result.target, result.mask),
        "lpips": None if lpips is None else lpips(result.counted[..., :3], result.target[..., :3]),
    }
    if result.scale.unit is not None:
        numbers |= {f"{MAE}{result.scale.unit}": None, f"{BIAS}{result.scale.unit}": None}
        if result.missed is not None and result.values is not None and result.values.isfinite().any():
            missed = result.missed[result.values.isfinite()]
            numbers[f"{MAE}{result.scale.unit}"] = missed.abs().mean().item()
            numbers[f"{BIAS}{result.scale.unit}"] = missed.mean().item()
    if result.formation is not None:
        numbers |= result.formation.scores(result.image, result.target, result.mask)
    return {name: _finite(number) for name, number in numbers.items()}


def _finite(number: float | None) -> float | None:
    """The number, or None in place of an infinite PSNR (equal images), which would swallow the mean."""
    return number if number is not None and math.isfinite(number) else None


def _comparison(result: RenderedView, decibels: float | None, span: tuple[float, float] | None = None) -> Comparison:
    """A view's images and its error; ``span`` has the values at the palette's ends, None: those of its scale."""
    render, truth = result.image.cpu().numpy(), result.target.cpu().numpy()
    error = (result.counted - result.target).abs().mean(dim=-1).cpu().numpy()
    without = "not finite" if np.isnan(error).any() else "exact"
    score = without if decibels is None else f"{decibels:.2f} dB"
    shown = spectrum_bytes(truth, result.scale, span), spectrum_bytes(render, result.scale, span)
    called = label(result.spectrum)
    unit = result.scale.measured_unit
    if unit is None or result.missed is None or result.scale.range is None:
        return Comparison(called, score, *shown, error, LARGEST_ERROR)
    low, high = span or result.scale.range
    missed = result.missed.abs().nan_to_num()  # unmeasured: no error
    largest = LARGEST_MEASURED_ERROR * (high - low)
    bar = result.scale.palette, low, high
    return Comparison(called, score, *shown, missed.cpu().numpy(), largest, unit=unit_label(unit), bar=bar)


def _means(rows: list[dict[str, Any]], spectrum: str) -> dict[str, float | None] | None:
    of_spectrum = [row for row in rows if row["spectrum"] == spectrum]
    if not of_spectrum:
        return None
    means: dict[str, float | None] = {}
    for column in of_spectrum[0].keys() - {"frame", "spectrum"}:
        values = [row[column] for row in of_spectrum if row[column] is not None]
        means[column] = float(np.mean(values)) if values else None
    return {column: means[column] for column in _ordered(means)}


def _ordered(columns: Iterable[str]) -> list[str]:
    """The metrics of every spectrum first, then errors of measured values, then the others by name."""
    others = sorted(set(columns) - set(COLUMNS))
    return [*COLUMNS, *sorted(others, key=lambda name: not name.startswith(MAE))]


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    columns = _ordered({column for row in rows for column in row} - {"frame", "spectrum"})
    table = io.StringIO()
    writer = csv.DictWriter(table, ["frame", "spectrum", *columns])
    writer.writeheader()
    writer.writerows(rows)  # None becomes an empty cell
    write_text(path, table.getvalue())
