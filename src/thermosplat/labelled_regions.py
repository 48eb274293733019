"""Errors inside the regions that are hard for one spectrum or the other, on captures that know where those are.

Every number is of all pixels of a region in all held-out views together: a view in which a region has ten pixels weighs
as much as ten pixels. Depth is the expected depth Σ w z / Σ w of what a spectrum sees, RGB with α, thermal with α_t.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame, Modality
from thermosplat.datasets.ground_truth import LABELS, GroundTruth, read_ground_truth
from thermosplat.evaluation import RenderedView, rendered_views
from thermosplat.model import SceneModel
from thermosplat.run_directory import RunDirectory

ALL = "all"
SURFACES_DIFFER = "surfaces differ"
REGIONS = (ALL, SURFACES_DIFFER, *(LABELS[label] for label in (1, 2, 3, 4, 5, 0)))
"""Regions in the order of tables."""
DIFFERING = 0.01
"""The true surfaces differ where the depths do by more than this share of RGB's. Depths stored in half precision are
rounded by 0.05%; a pane a hand's breadth before a wall ten metres away is 1% off."""


class Column(NamedTuple):
    """A number of a region, as tables show it."""

    heading: str
    modality: Modality
    measure: str
    form: str

    def value(self, numbers: Mapping[str, Any]) -> float | None:
        """The number of a region; None where it was not measured."""
        return (numbers[self.modality] or {}).get(self.measure)


COLUMNS = (
    Column("RGB PSNR [dB]", "rgb", "psnr", "{:.2f}"),
    Column("thermal PSNR [dB]", "thermal", "psnr", "{:.2f}"),
    Column("MAE [°C]", "thermal", "mae_celsius", "{:.3f}"),
    Column("RGB depth error", "rgb", "depth_error", "{:.4f}"),
    Column("RGB depth error, relative", "rgb", "depth_error_relative", "{:.2%}"),
    Column("thermal depth error", "thermal", "depth_error", "{:.4f}"),
    Column("thermal depth error, relative", "thermal", "depth_error_relative", "{:.2%}"),
    Column("RGB on own surface", "rgb", "on_own_surface", "{:.1%}"),
    Column("thermal on own surface", "thermal", "on_own_surface", "{:.1%}"),
)

Regions = dict[str, dict[str, Any]]
"""Numbers by region (``region_errors``)."""


@torch.no_grad()
def region_errors(model: SceneModel, capture: Capture, *, sh_degree: int, device: torch.device | str) -> Regions | None:
    """Image and depth errors by region, over the held-out views that have ground truth.

    Args:
        model: The scene.
        capture: Its capture; ``capture.test`` is rendered.
        sh_degree: Highest SH degree in use.
        device: Where the model is.

    Returns:
        By region, in the order of ``REGIONS``, those with pixels only: "pixels", "rgb" and "thermal", each with "psnr"
        [dB], "mae" (of images in [0, 1]), "mae_celsius" [°C] (thermal only), and the medians of the absolute and
        relative error of the depth ("depth_error" [world units], "depth_error_relative"), over pixels that have a true
        depth; and "on_own_surface", the share of the pixels whose depth is nearer to the surface that this spectrum
        sees than to the other's, of those where the two differ. None where no held-out view has ground truth.
    """
    samples: dict[str, _Samples] = {name: _Samples() for name in REGIONS}
    found = False
    for frame in capture.test:
        read = read_ground_truth(capture, frame)
        if read is not None:
            found, truth = True, _Truth.on(device, read)
            maps = _error_maps(model, capture, frame, truth, sh_degree, device)
            for name, mask in truth.masks().items():
                samples[name].add(mask, maps)
    return {name: of_region.numbers() for name, of_region in samples.items() if of_region.pixels} if found else None


def write_regions(
    run: RunDirectory,
    model: SceneModel,
    capture: Capture,
    steps: int,
    sh_degree: int,
    device: torch.device | str,
    *,
    path: Path | None = None,
) -> Regions | None:
    """Measure ``region_errors`` and write the run's regions.json; without ground truth nothing is written.

    Args:
        run: The run folder.
        model: The scene.
        capture: Its capture.
        steps: Training steps done.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
        path: Another file in place of regions.json.

    Returns:
        The errors.
    """
    regions = region_errors(model, capture, sh_degree=sh_degree, device=device)
    if regions is not None:
        run.write_json(path or run.regions_json, {"steps": steps, "regions": regions})
    return regions


@dataclass(frozen=True, eq=False)
class _Truth:
    """Ground truth of a frame on a device."""

    depths: dict[str, Tensor]
    """By modality, [H, W]; 0 where there is no surface."""
    label: Tensor
    """[H, W], keys of ``LABELS``."""

    @classmethod
    def on(cls, device: torch.device | str, truth: GroundTruth) -> "_Truth":
        depths = {modality: torch.tensor(depth, device=device) for modality, depth in truth.depths.items()}
        return cls(depths, torch.tensor(truth.label.astype(np.uint8), device=device))

    def masks(self) -> dict[str, Tensor]:
        masks = {name: self.label == label for label, name in LABELS.items()}
        masks[SURFACES_DIFFER] = self.surfaces_differ()
        masks[ALL] = torch.ones_like(masks[SURFACES_DIFFER])
        return masks

    def surfaces_differ(self) -> Tensor:
        """Also where only one spectrum sees a surface: the other's depth is 0 there."""
        rgb, thermal = self.depths["rgb"], self.depths["thermal"]
        return (rgb - thermal).abs() > DIFFERING * rgb


Maps = dict[Modality, dict[str, Tensor]]
"""Errors of every pixel by modality and kind, float64 [H, W]; NaN where there is nothing to compare with."""


def _error_maps(
    model: SceneModel,
    capture: Capture,
    frame: Frame,
    truth: _Truth,
    sh_degree: int,
    device: torch.device | str,
) -> Maps:
    return {
        view.modality: _image_errors(view)
        | _depth_errors(model.render_depth(view.modality, view.camera), view.modality, truth)
        for view in rendered_views(model, frame, capture.thermal_scale, sh_degree, device)
    }


def _depth_errors(rendered: Tensor, modality: Modality, truth: _Truth) -> dict[str, Tensor]:
    depth = rendered.double()
    own, other = (
        truth.depths[name].double().where(truth.depths[name] > 0, torch.nan)
        for name in (modality, "thermal" if modality == "rgb" else "rgb")
    )
    error = (depth - own).abs()
    right = (error < (depth - other).abs()) & (depth > 0)  # 0: no Gaussian is there
    known = truth.surfaces_differ() & ~own.isnan() & ~other.isnan()
    return {
        "depth_error": error,
        "depth_error_relative": error / own,
        "on_own_surface": right.double().where(known, torch.nan),
    }


def _image_errors(view: RenderedView) -> dict[str, Tensor]:
    difference = (view.image - view.target).double()
    errors = {"squared": difference.square().mean(dim=-1), "absolute": difference.abs().mean(dim=-1)}
    if view.scale is not None and view.celsius is not None:
        errors["celsius"] = (view.scale.celsius(view.intensity).double() - view.celsius.double()).abs()
    return errors


@dataclass
class _Samples:
    """The errors of a region's pixels, view after view."""

    pixels: int = 0
    errors: dict[tuple[str, str], list[Tensor]] = field(default_factory=dict)

    def add(self, mask: Tensor, maps: Maps) -> None:
        where = mask.flatten().nonzero().squeeze(1)  # once for all maps: a device is waited for
        self.pixels += len(where)
        for modality, errors in maps.items():
            for kind, error in errors.items():
                self.errors.setdefault((modality, kind), []).append(error.take(where))

    def numbers(self) -> dict[str, Any]:
        modalities = dict.fromkeys(modality for modality, _ in self.errors)
        return {"pixels": self.pixels, "rgb": None, "thermal": None} | {
            modality: self._of(modality) for modality in modalities
        }

    def _of(self, modality: str) -> dict[str, float | None]:
        def over(kind: str, statistic: Callable[[Tensor], Tensor]) -> float | None:
            parts = self.errors.get((modality, kind), [])
            number = statistic(torch.cat(parts)).item() if parts else math.nan
            return None if math.isnan(number) else number

        squared = over("squared", torch.nanmean)
        numbers = {"psnr": -10.0 * math.log10(squared) if squared else None, "mae": over("absolute", torch.nanmean)}
        if modality == "thermal":
            numbers["mae_celsius"] = over("celsius", torch.nanmean)
        numbers |= {kind: over(kind, _median) for kind in ("depth_error", "depth_error_relative")}
        return numbers | {"on_own_surface": over("on_own_surface", torch.nanmean)}


def _median(values: Tensor) -> Tensor:
    """The mean of the two middle values where their number is even, of which torch's median is the lower one."""
    return (values.nanmedian() - (-values).nanmedian()) / 2
