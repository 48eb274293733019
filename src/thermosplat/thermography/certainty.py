"""How sure a temperature is, pixel by pixel, and where none should be read.

A picture's values are compared with the training images that were taken nearest to it, as they look from there. What
they differ by (spread), the noise of the sensor, the level that drifts from image to image, and half a pixel of the
temperature's slope make

    s² = noise² + drift² + spread² + (slope / 2)²

Held-out views then tell by how many s a temperature is wrong in 95 of 100 pixels, for small and for large s apart
(split conformal prediction: Vovk, Gammerman and Shafer 2005). So an interval holds 95% on views like those of the
capture. A level is one number for all pixels of an image, and a handful of held-out views knows few of them. So no
interval is narrower than 1.96 times the drift, which holds 95% of the levels of all training views. Intervals say
nothing of surfaces whose emissivity is another one than was assumed.
"""

import json
import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.runs.atomic_writes import write_text
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.reprojection import (
    HIDDEN,
    camera_points,
    coarse_view,
    pose_distances,
    sampled,
    seen_from,
)

Array = NDArray[np.float64]
LEVEL = 0.95
"""Share of pixels that intervals are to hold."""
_NEAREST, _LOOKED_AT = 8, 24
"""Training views that are compared with, and those of which it is asked whether they see a point."""
_NORMAL = 1.96
"""Standard deviations of a normal distribution within which 95% lie."""
_BINS = 4
"""Of s, each with a factor of its own."""
_MOST_CALIBRATING = 12
"""Views of either kind that are rendered for it."""
FEW_VIEWS, GRAZING, REFLECTING, DEPTHS_DIFFER, SMALL, NO_SURFACE = (1 << bit for bit in range(6))
DOUBTS = {
    FEW_VIEWS: "fewer than three views saw it",
    GRAZING: "it was seen at grazing angles only",
    REFLECTING: "it changes with the direction, as reflections do",
    DEPTHS_DIFFER: "the spectra disagree about its depth",
    SMALL: "it is smaller than 3x3 pixels of the sensor",
    NO_SURFACE: "no surface is there",
}
"""Why a value should not be read."""
_FEWEST_VIEWS = 3
_LEAST_COSINE = 0.26
"""75° from straight on: emissivity of most surfaces falls beyond 60 to 70° (Minkina and Dudzik 2009)."""
_DEPTHS_APART = 0.04
"""Share of a depth by which the spectra's may differ."""
_SOLID = 0.5
"""Opacity from which on a spectrum says how far away a surface is."""
_TIMES_USUAL = 3.0
"""Times the usual disagreement (the picture's median) from which on that of views counts as a reflection, if it is also
more than so many times the noise, and that of depths as two surfaces."""


@dataclass(frozen=True)
class Calibration:
    """What held-out views say of a scene's temperatures."""

    noise: float
    """Standard deviation of the sensor's noise, in the unit of the values."""
    drift: float
    """Standard deviation of the level from image to image that the scene does not explain."""
    edges: tuple[float, ...]
    """Ends of the bins of s."""
    factors: tuple[float, ...]
    """Half of the interval in each bin, in s; one more than edges."""

    def half_width(self, s: Array) -> Array:
        """Half of the interval for each s."""
        return np.maximum(np.asarray(self.factors)[np.searchsorted(self.edges, s)] * s, _NORMAL * self.drift)


@dataclass(frozen=True, eq=False)
class Sure:
    """How sure a picture's values are."""

    half_width: Array
    """Half of the 95% interval, [H, W], in the unit of the values; NaN where there is no surface."""
    doubts: NDArray[np.uint8]
    """Why a value should not be read, bits of ``DOUBTS``, [H, W]; 0: it may be."""


class Certainty:
    """How sure the temperatures of a scene are.

    Args:
        model: The scene.
        capture: Its capture, whose training images are compared with.
        spectrum: A spectrum that measures something.
        scale: What its pixel values mean.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
        keep: File of the calibration; None: it is made anew. Where there is none it is made and written.
    """

    def __init__(
        self,
        model: SceneModel,
        capture: Capture,
        spectrum: str,
        scale: PixelScale,
        *,
        sh_degree: int,
        device: torch.device | str,
        keep: Path | None = None,
    ) -> None:
        self.model, self.capture, self.spectrum, self.scale = model, capture, spectrum, scale
        self._sh_degree, self._device, self._keep = sh_degree, device, keep
        self._frames = [frame for frame in capture.train if spectrum in frame.views]
        if not self._frames:
            raise UserError(f"{capture.root} has no {spectrum} images to compare with.")
        self._poses = np.stack([frame.views[spectrum].viewmat for frame in self._frames])
        places = np.linalg.inv(self._poses)[:, :3, 3]
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        self._spacing = float(np.median(apart.min(axis=1))) if len(places) > 1 else 1.0
        self._taken = lru_cache(maxsize=512)(self._taken_anew)
        self._calibration: Calibration | None = None

    @torch.no_grad()
    def of_view(self, view: ViewTensors, values: NDArray[np.floating]) -> Sure:
        """How sure the values of a view are.

        Args:
            view: From where they were rendered.
            values: What was rendered, [H, W], as the capture has it (not recalculated).
        """
        s, doubts = self._evidence(view, values.astype(np.float64), self.calibration.noise, self.calibration.drift)
        return Sure(self.calibration.half_width(s), doubts)

    @property
    def is_known(self) -> bool:
        """Whether the calibration is at hand; else it takes a while."""
        return self._calibration is not None or (self._keep is not None and _read(self._keep) is not None)

    @property
    def calibration(self) -> Calibration:
        """What held-out views say; found when it is first asked for."""
        if self._calibration is None:
            known = None if self._keep is None else _read(self._keep)
            self._calibration = known or self.calibrated(list(self.capture.test) or self._frames)
            if known is None and self._keep is not None:
                write_text(self._keep, json.dumps(asdict(self._calibration)) + "\n")
        return self._calibration

    @torch.no_grad()
    def calibrated(self, frames: list[Frame]) -> Calibration:
        """What some views say of the scene's temperatures.

        Args:
            frames: Views that the scene was not trained on.
        """
        learnt = self._frames[:: max(1, len(self._frames) // _MOST_CALIBRATING)]
        images = [self._compared(frame) for frame in learnt]
        noise = float(np.median([_noise(expected) for _, _, expected in images]))
        levels = np.array([np.nanmedian(expected - rendered) for _, rendered, expected in images])
        drift = float(1.4826 * np.median(np.abs(levels - np.median(levels))))
        sizes, errors = [], []
        held_out = [frame for frame in frames if self.spectrum in frame.views]
        for frame in held_out[:: max(1, len(held_out) // _MOST_CALIBRATING)]:
            view, rendered, expected = self._compared(frame)
            s, _ = self._evidence(view, rendered, noise, drift)
            there = np.isfinite(s) & np.isfinite(expected)
            sizes.append(s[there])
            errors.append(np.abs(rendered - expected)[there])
        size, error = np.concatenate(sizes), np.concatenate(errors)
        if len(size) < 100:
            return Calibration(noise, drift, (), (2.0,))
        edges = np.quantile(size, np.linspace(0, 1, _BINS + 1)[1:-1])
        of_bin = np.searchsorted(edges, size)
        ratios = error / np.maximum(size, 1e-12)
        factors = [float(np.quantile(ratios[of_bin == k], LEVEL)) if (of_bin == k).any() else 2.0 for k in range(_BINS)]
        return Calibration(noise, drift, tuple(map(float, edges)), tuple(factors))

    def compared(self, frame: Frame, calibration: Calibration) -> tuple[Array, Array, NDArray[np.uint8]]:
        """Errors [H, W], halves of the intervals and doubts of a view that has an image."""
        view, rendered, expected = self._compared(frame)
        s, doubts = self._evidence(view, rendered, calibration.noise, calibration.drift)
        return rendered - expected, calibration.half_width(s), doubts

    def _compared(self, frame: Frame) -> tuple[ViewTensors, Array, Array]:
        """A frame's view, and its values as they are rendered and as they were measured, [H, W]."""
        view = view_tensors(frame.views[self.spectrum], None, self._device)
        image = self.model.render({self.spectrum: view}, sh_degree=self._sh_degree).images[self.spectrum]
        rendered = self.scale.value(pixel_intensity(image.clamp(0, 1), self.scale)).double().cpu().numpy()
        return view, rendered, self._measured(view).double().cpu().numpy()

    def _measured(self, view: ViewTensors) -> Tensor:
        """Values of a photograph, [H, W]; within the range that a scene can show."""
        if view.values is not None:
            span = self.scale.range
            return view.values if span is None else view.values.clamp(*span)
        assert view.image is not None  # noqa: S101  a view of a capture
        values: Tensor = self.scale.value(pixel_intensity(view.image, self.scale))
        return values

    def _taken_anew(self, index: int) -> tuple[ViewTensors, Tensor, Tensor]:
        """A training view of a size that tells what is hidden: its camera, values and depths."""
        view = view_tensors(self._frames[index].views[self.spectrum], None, self._device)
        camera = coarse_view(view)
        values = torch.nn.functional.interpolate(
            self._measured(view)[None, None], (camera.height, camera.width), mode="area"
        )[0, 0]
        return camera, values, self._surface(*self._seen_by_each(camera))

    def _evidence(
        self, view: ViewTensors, values: Array, noise: float, drift: float
    ) -> tuple[Array, NDArray[np.uint8]]:
        """s of each pixel, and its doubts."""
        solid, of_each = self._seen_by_each(view)
        depth = self._surface(solid, of_each)
        apart = pose_distances(self._poses, view.viewmat.cpu().numpy(), self._spacing)
        order = [int(index) for index in np.argsort(apart) if apart[index] > 1e-4][:_LOOKED_AT]
        normals = _normals(depth, view)
        shown = torch.as_tensor(values, dtype=torch.float32, device=depth.device)
        seen = torch.zeros_like(depth)
        facing = torch.zeros_like(depth)
        squares, compared = torch.zeros_like(depth), torch.zeros_like(depth)
        points = camera_points(view, depth)
        for rank, index in enumerate(order):
            camera, taken, taken_depth = self._taken(index)
            positions, depths = seen_from(camera, view, depth)
            there = sampled(torch.stack([taken, taken_depth], dim=-1), positions)
            visible = depths <= (1 + HIDDEN) * there[..., 1]
            seen += visible
            place = view.viewmat @ torch.linalg.inv(camera.viewmat)[:, 3]
            towards = place[:3] - points
            cosine = (towards * normals).sum(dim=-1).abs() / towards.norm(dim=-1).clamp(min=1e-9)
            facing = torch.maximum(facing, torch.where(visible, cosine, 0.0))
            if rank < _NEAREST:
                difference = torch.where(visible, there[..., 0] - shown, 0.0).nan_to_num()
                squares += difference.square()
                compared += visible
        spread = torch.sqrt(squares / compared.clamp(min=1)).double().cpu().numpy()
        slope = np.hypot(*np.gradient(np.nan_to_num(values, nan=float(np.nanmedian(values)))))
        s = np.sqrt(noise**2 + drift**2 + spread**2 + (slope / 2) ** 2)
        surface = (depth > 0).cpu().numpy() & np.isfinite(values)
        doubts = np.zeros(values.shape, np.uint8)
        doubts[seen.cpu().numpy() < _FEWEST_VIEWS] |= FEW_VIEWS
        doubts[(facing < _LEAST_COSINE).cpu().numpy() & (seen > 0).cpu().numpy()] |= GRAZING
        usual = float(np.median(spread[surface])) if surface.any() else 0.0
        explained = np.hypot(slope, max(_TIMES_USUAL * usual, _TIMES_USUAL * noise))
        doubts[cv2.medianBlur(spread.astype(np.float32), 5) > explained] |= REFLECTING
        doubts[self._depths_differ(solid, of_each)] |= DEPTHS_DIFFER
        doubts[_small(values, noise, depth, view, self._taken(order[0])[0] if order else view)] |= SMALL
        doubts[~surface] = NO_SURFACE
        return np.where(surface, s, np.nan), doubts

    def _seen_by_each(self, view: ViewTensors) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """By spectrum, where it shows a surface in a view, and how deep, both [H, W]."""
        alphas = self.model.render(dict.fromkeys(self.model.spectra, view), sh_degree=self._sh_degree).alphas
        solid = {name: alpha[..., 0] >= _SOLID for name, alpha in alphas.items()}
        return solid, {name: self.model.render_depth(name, view) for name in self.model.spectra}

    def _surface(self, solid: dict[str, Tensor], depths: dict[str, Tensor]) -> Tensor:
        """Depth of what a view sees, [H, W].

        What is as cold as the range's lower end may be transparent in the spectrum: its depth there is another one's.
        """
        depth = depths[self.spectrum]
        for other, theirs in depths.items():
            depth = torch.where(~solid[self.spectrum] & solid[other], theirs, depth)
        return depth

    def _depths_differ(self, solid: dict[str, Tensor], depths: dict[str, Tensor]) -> NDArray[np.bool_]:
        """Where another spectrum sees a surface at another depth, [H, W]."""
        depth = depths[self.spectrum]
        differ = torch.zeros_like(depth, dtype=torch.bool)
        for other, theirs in depths.items():
            if other != self.spectrum:
                both = solid[self.spectrum] & solid[other]
                apart = (theirs - depth).abs() / torch.minimum(theirs, depth).clamp(min=1e-9)
                usual = float(apart[both & (depth > 0)].median().nan_to_num())
                differ |= both & (apart > max(_DEPTHS_APART, _TIMES_USUAL * usual))
        opened = cv2.morphologyEx(differ.cpu().numpy().astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        return opened > 0


def _normals(depth: Tensor, view: ViewTensors) -> Tensor:
    """Unit normals of what a view sees, in camera axes, [H, W, 3]."""
    smooth = torch.nn.functional.avg_pool2d(depth[None, None], 5, 1, 2, count_include_pad=False)[0, 0]
    points = camera_points(view, smooth)
    down, across = torch.gradient(points, dim=(0, 1))
    normal = torch.linalg.cross(across, down)
    return normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-20)


def _small(values: Array, noise: float, depth: Tensor, view: ViewTensors, sensor: ViewTensors) -> NDArray[np.bool_]:
    """Where a value stands out of a surrounding of 3x3 pixels of the sensor, by more than its noise explains."""
    seen = depth[depth > 0]
    away = float(seen.median()) if view.orthographic and len(seen) else 1.0
    size = 3 * away * float(view.K[0, 0]) / float(sensor.K[0, 0])
    window = min(max(3, 2 * round(size / 2) + 1), 5)  # OpenCV's largest of floats
    filled = np.nan_to_num(values, nan=float(np.nanmedian(values))).astype(np.float32)
    apart = np.abs(filled - cv2.medianBlur(filled, window))
    return apart > max(5 * noise, 0.02 * float(np.ptp(filled)))


def _noise(values: Array) -> float:
    """Standard deviation of white noise in an image (Immerkaer 1996), of the half of the image with less structure."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float64)
    response = np.abs(cv2.filter2D(np.nan_to_num(values, nan=float(np.nanmedian(values))), cv2.CV_64F, kernel))
    return float(np.median(response[1:-1, 1:-1]) / 0.6745 / 6)


def _read(path: Path) -> Calibration | None:
    """A calibration that was kept; None where there is none that can be read."""
    try:
        stated = json.loads(read_regular(path))
        edges, factors = (tuple(map(float, stated[name])) for name in ("edges", "factors"))
        made = Calibration(float(stated["noise"]), float(stated["drift"]), edges, factors)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sound = len(factors) == len(edges) + 1 and all(map(math.isfinite, (*edges, *factors, made.noise, made.drift)))
    return made if sound else None
