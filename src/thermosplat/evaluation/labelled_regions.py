"""Errors inside the regions that are hard for one spectrum or the other, on captures that know where those are.

Every number is of all pixels of a region in all held-out views together: a view in which a region has ten pixels weighs
as much as ten pixels. Depth is the median depth of what a spectrum sees, with its own opacity.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.ground_truth import LABELS, GroundTruth, read_ground_truth
from thermosplat.evaluation.held_out import RenderedView, rendered_views
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import MAE, label, unit_label
from thermosplat.thermography.scene_temperatures import SceneTemperatures

ALL = "all"
PIXELS = "pixels"
SURFACES_DIFFER = "surfaces differ"
REGIONS = (ALL, SURFACES_DIFFER, *(LABELS[label] for label in (1, 2, 3, 4, 5, 0)))
"""Regions in the order of tables."""
DIFFERING = 0.01
"""The true surfaces differ where the depths do by more than this share of the first spectrum's. Depths stored in half
precision are rounded by 0.05%; a pane a hand's breadth before a wall ten metres away is 1% off."""


class Column(NamedTuple):
    """A number of a region, as tables show it."""

    heading: str
    spectrum: str
    measure: str
    form: str

    def value(self, numbers: Mapping[str, Any]) -> float | None:
        """The number of a region; None where it was not measured."""
        return (numbers.get(self.spectrum) or {}).get(self.measure)


def region_columns(regions: Iterable[Mapping[str, Any]]) -> list[Column]:
    """The columns of a table of regions."""
    found = {
        name: dict.fromkeys(measure for numbers in regions for measure in numbers.get(name) or {})
        for name in dict.fromkeys(name for numbers in regions for name in numbers if name != PIXELS)
    }
    columns = [Column(f"{label(name)} PSNR [dB]", name, "psnr", "{:.2f}") for name in found]
    for name, measures in found.items():
        for measure in measures:
            if measure.startswith(MAE):
                unit = unit_label(measure.removeprefix(MAE))
                columns.append(Column(f"{label(name)} MAE [{unit}]", name, measure, "{:.3f}"))
    for name in found:
        columns.append(Column(f"{label(name)} depth error", name, "depth_error", "{:.4f}"))
        columns.append(Column(f"{label(name)} depth error, relative", name, "depth_error_relative", "{:.2%}"))
    columns += [Column(f"{label(name)} on own surface", name, "on_own_surface", "{:.1%}") for name in found]
    return columns


Regions = dict[str, dict[str, Any]]
"""Numbers by region (``region_errors``)."""


@torch.no_grad()
def region_errors(
    model: SceneModel,
    capture: Capture,
    *,
    sh_degree: int,
    temperatures: SceneTemperatures | None = None,
) -> Regions | None:
    """Image and depth errors by region, over the held-out views that have ground truth.

    Args:
        capture: Its capture; ``capture.test`` is rendered.
        temperatures: How temperatures are recalculated before they are compared; None: they are not.

    Returns:
        By region, in the order of ``REGIONS``, those with pixels only: "pixels", and by spectrum "psnr" [dB], "mae" (of
        images in [0, 1]), "mae_<unit>" where values are measured, and the medians of the absolute and relative error of
        the depth ("depth_error" [world units], "depth_error_relative"), over pixels that have a true depth; and
        "on_own_surface", the share of the pixels whose depth is nearer to the surface that this spectrum sees than to
        another one's, of those where the two differ. None where no held-out view has ground truth.
    """
    samples: dict[str, _Samples] = {name: _Samples(list(model.spectra)) for name in REGIONS}
    found = False
    for frame in capture.test:
        read = read_ground_truth(capture, frame)
        if read is not None:
            found, truth = True, _Truth.on(model.device, read)
            maps = _error_maps(model, capture, frame, truth, sh_degree, temperatures)
            for name, mask in truth.masks().items():
                samples[name].add(mask, maps)
    return {name: of_region.numbers() for name, of_region in samples.items() if of_region.pixels} if found else None


def write_regions(
    run: RunDirectory,
    model: SceneModel,
    capture: Capture,
    steps: int,
    sh_degree: int,
    *,
    path: Path | None = None,
    temperatures: SceneTemperatures | None = None,
) -> Regions | None:
    """Measure ``region_errors`` and write the run's regions.json; without ground truth nothing is written.

    Args:
        path: Another file in place of regions.json.
    """
    regions = region_errors(model, capture, sh_degree=sh_degree, temperatures=temperatures)
    if regions is not None:
        run.write_json(path or run.regions_json, {"steps": steps, "regions": regions})
    return regions


@dataclass(frozen=True, eq=False)
class _Truth:
    """Ground truth of a frame on a device."""

    depths: dict[str, Tensor]
    """By spectrum, [H, W]; 0 where there is no surface."""
    label: Tensor
    """[H, W], keys of ``LABELS``."""

    @classmethod
    def on(cls, device: torch.device | str, truth: GroundTruth) -> "_Truth":
        depths = {name: torch.tensor(depth, device=device) for name, depth in truth.depths.items()}
        return cls(depths, torch.tensor(truth.label.astype(np.uint8), device=device))

    def masks(self) -> dict[str, Tensor]:
        masks = {name: self.label == label for label, name in LABELS.items()}
        masks[SURFACES_DIFFER] = self.surfaces_differ()
        masks[ALL] = torch.ones_like(masks[SURFACES_DIFFER])
        return masks

    def surfaces_differ(self) -> Tensor:
        """Also where only one spectrum sees a surface: the other's depth is 0 there."""
        first, *others = self.depths.values()
        differ = torch.zeros_like(first, dtype=torch.bool)
        for other in others:
            differ |= (first - other).abs() > DIFFERING * first
        return differ


Maps = dict[str, dict[str, Tensor]]
"""Errors of every pixel by spectrum and kind, float64 [H, W]; NaN where there is nothing to compare with."""


def _error_maps(
    model: SceneModel,
    capture: Capture,
    frame: Frame,
    truth: _Truth,
    sh_degree: int,
    temperatures: SceneTemperatures | None,
) -> Maps:
    return {
        view.spectrum: _image_errors(view) | _depth_errors(model, view, truth)
        for view in rendered_views(model, frame, capture.scales, sh_degree, temperatures)
    }


def _depth_errors(model: SceneModel, view: RenderedView, truth: _Truth) -> dict[str, Tensor]:
    if view.spectrum not in truth.depths:
        return {}
    depth = model.placement.unit * model.render_depth(view.spectrum, view.camera).double()
    depths = {name: true.double().where(true > 0, torch.nan) for name, true in truth.depths.items()}
    own = depths.pop(view.spectrum)
    error = (depth - own).abs()
    errors = {"depth_error": error, "depth_error_relative": error / own}
    if depths:
        others = torch.stack(list(depths.values()))
        nearest = (depth - others).abs().nan_to_num(torch.inf).amin(dim=0)
        right = (error < nearest) & (depth > 0)  # 0: no Gaussian is there
        known = truth.surfaces_differ() & ~own.isnan() & ~others.isnan().all(dim=0)
        errors["on_own_surface"] = right.double().where(known, torch.nan)
    return errors


def _image_errors(view: RenderedView) -> dict[str, Tensor]:
    difference = (view.image - view.target).double()
    if view.mask is not None:
        difference = difference.where(view.mask[..., None], torch.nan)
    errors = {"squared": difference.square().mean(dim=-1), "absolute": difference.abs().mean(dim=-1)}
    if view.scale.unit is not None:
        nothing = torch.full_like(errors["absolute"], torch.nan)
        errors[f"{MAE}{view.scale.unit}"] = nothing if view.missed is None else view.missed.abs()
    return errors


@dataclass
class _Samples:
    """The errors of a region's pixels, view after view."""

    spectra: list[str]
    pixels: int = 0
    errors: dict[tuple[str, str], list[Tensor]] = field(default_factory=dict)

    def add(self, mask: Tensor, maps: Maps) -> None:
        where = mask.flatten().nonzero().squeeze(1)  # once for all maps: a device is waited for
        self.pixels += len(where)
        for spectrum, errors in maps.items():
            for kind, error in errors.items():
                self.errors.setdefault((spectrum, kind), []).append(error.take(where))

    def numbers(self) -> dict[str, Any]:
        seen = {spectrum for spectrum, _ in self.errors}
        return {PIXELS: self.pixels} | {name: self._of(name) if name in seen else None for name in self.spectra}

    def _of(self, spectrum: str) -> dict[str, float | None]:
        def over(kind: str, statistic: Callable[[Tensor], Tensor]) -> float | None:
            parts = self.errors.get((spectrum, kind), [])
            number = statistic(torch.cat(parts)).item() if parts else math.nan
            return None if math.isnan(number) else number

        squared = over("squared", torch.nanmean)
        numbers = {"psnr": -10.0 * math.log10(squared) if squared else None, "mae": over("absolute", torch.nanmean)}
        measured = [kind for of_spectrum, kind in self.errors if of_spectrum == spectrum and kind.startswith(MAE)]
        numbers |= {kind: over(kind, torch.nanmean) for kind in measured}
        numbers |= {kind: over(kind, _median) for kind in ("depth_error", "depth_error_relative")}
        return numbers | {"on_own_surface": over("on_own_surface", torch.nanmean)}


def _median(values: Tensor) -> Tensor:
    """The mean of the two middle values where their number is even, of which torch's median is the lower one."""
    return (values.nanmedian() - (-values).nanmedian()) / 2
