"""Errors inside the regions that are hard for one spectrum or the other, on captures that know where those are.

Every number is of all pixels of a region in all held-out views together: a view in which a region has ten pixels weighs
as much as ten pixels. Depth is the expected depth Σ w z / Σ w of what a spectrum sees, RGB with α, thermal with α_t.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame, Modality
from thermosplat.datasets.frame_tensors import frame_tensors
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
        truth = read_ground_truth(capture, frame)
        if truth is not None:
            found = True
            maps = _error_maps(model, capture, frame, truth, sh_degree, device)
            for name, mask in _masks(truth).items():
                samples[name].add(mask, maps)
    return {name: of_region.numbers() for name, of_region in samples.items() if of_region.pixels} if found else None


def write_regions(
    run: RunDirectory, model: SceneModel, capture: Capture, steps: int, sh_degree: int, device: torch.device | str
) -> Regions | None:
    """Measure ``region_errors`` and write the run's regions.json; without ground truth nothing is written.

    Args:
        run: The run folder.
        model: The scene.
        capture: Its capture.
        steps: Training steps done.
        sh_degree: Highest SH degree in use.
        device: Where the model is.

    Returns:
        The errors.
    """
    regions = region_errors(model, capture, sh_degree=sh_degree, device=device)
    if regions is not None:
        run.write_json(run.regions_json, {"steps": steps, "regions": regions})
    return regions


def _masks(truth: GroundTruth) -> dict[str, NDArray[np.bool_]]:
    masks = {name: truth.label == label for label, name in LABELS.items()}
    masks[SURFACES_DIFFER] = _surfaces_differ(truth)
    masks[ALL] = np.ones_like(masks[SURFACES_DIFFER])
    return masks


def _surfaces_differ(truth: GroundTruth) -> NDArray[np.bool_]:
    """Also where only one spectrum sees a surface: the other's depth is 0 there."""
    rgb, thermal = truth.depths["rgb"], truth.depths["thermal"]
    return np.abs(rgb - thermal) > DIFFERING * rgb


Maps = dict[Modality, dict[str, NDArray[np.float64]]]
"""Errors of every pixel by modality and kind, [H, W]; NaN where there is nothing to compare with."""


def _error_maps(
    model: SceneModel,
    capture: Capture,
    frame: Frame,
    truth: GroundTruth,
    sh_degree: int,
    device: torch.device | str,
) -> Maps:
    maps: Maps = {
        view.modality: _image_errors(view)
        for view in rendered_views(model, frame, capture.thermal_scale, sh_degree, device)
    }
    tensors = frame_tensors(frame, capture.thermal_scale, device)
    for modality, view in (("rgb", tensors.rgb), ("thermal", tensors.thermal)):
        if view is not None and modality in maps:
            maps[modality] |= _depth_errors(model.render_depth(modality, view).cpu().double().numpy(), modality, truth)
    return maps


def _depth_errors(depth: NDArray[np.float64], modality: Modality, truth: GroundTruth) -> dict[str, NDArray[np.float64]]:
    own, other = (
        np.where(truth.depths[name] > 0, truth.depths[name].astype(np.float64), np.nan)
        for name in (modality, "thermal" if modality == "rgb" else "rgb")
    )
    error = np.abs(depth - own)
    right = (error < np.abs(depth - other)) & (depth > 0)  # 0: no Gaussian is there
    known = _surfaces_differ(truth) & ~np.isnan(own) & ~np.isnan(other)
    return {
        "depth_error": error,
        "depth_error_relative": error / own,
        "on_own_surface": np.where(known, right.astype(np.float64), np.nan),
    }


def _image_errors(view: RenderedView) -> dict[str, NDArray[np.float64]]:
    difference = (view.image - view.target).double()
    errors = {
        "squared": difference.square().mean(dim=-1).cpu().numpy(),
        "absolute": difference.abs().mean(dim=-1).cpu().numpy(),
    }
    if view.scale is not None and view.celsius is not None:
        celsius = np.asarray(view.scale.celsius(view.intensity.numpy()), dtype=np.float64)
        errors["celsius"] = np.abs(celsius - view.celsius.cpu().double().numpy())
    return errors


@dataclass
class _Samples:
    """The errors of a region's pixels, view after view."""

    pixels: int = 0
    errors: dict[tuple[str, str], list[NDArray[np.float64]]] = field(default_factory=dict)

    def add(self, mask: NDArray[np.bool_], maps: Maps) -> None:
        self.pixels += int(mask.sum())
        for modality, errors in maps.items():
            for kind, error in errors.items():
                self.errors.setdefault((modality, kind), []).append(error[mask])

    def numbers(self) -> dict[str, Any]:
        modalities = dict.fromkeys(modality for modality, _ in self.errors)
        return {"pixels": self.pixels, "rgb": None, "thermal": None} | {
            modality: self._of(modality) for modality in modalities
        }

    def _of(self, modality: str) -> dict[str, float | None]:
        def over(kind: str, statistic: Any) -> float | None:
            parts = self.errors.get((modality, kind), [])
            values = np.concatenate(parts) if parts else np.empty(0)
            values = values[~np.isnan(values)]
            return float(statistic(values)) if len(values) else None

        squared = over("squared", np.mean)
        numbers = {"psnr": -10.0 * math.log10(squared) if squared else None, "mae": over("absolute", np.mean)}
        if modality == "thermal":
            numbers["mae_celsius"] = over("celsius", np.mean)
        numbers |= {kind: over(kind, np.median) for kind in ("depth_error", "depth_error_relative")}
        return numbers | {"on_own_surface": over("on_own_surface", np.mean)}
