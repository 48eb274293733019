"""How sure a temperature is, pixel by pixel, and where none should be read.

A picture's values are compared with the training images that were taken nearest to it, as they look from there. What
they differ by (spread), the noise of the sensor, the level that drifts from image to image, and half a pixel of the
temperature's slope make

    s² = noise² + level² + spread² + (slope / 2)²

Held-out views then tell by how many s a temperature is wrong in 95 of 100 pixels (calibration.py). So an interval holds
95% on views like those of the capture. Intervals say nothing of surfaces whose emissivity is another one than was
assumed.

Whether the spectra see different surfaces, as at glass, the images tell, not depths alone: around warm things the depth
of plain surfaces is wrong in the thermal spectrum, since nothing there says what it is. So the other spectrum's images
must agree less at the thermal depth than at their own, and thermal images must disagree at the other's.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
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
from thermosplat.runs.atomic_writes import write_text
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.calibration import Calibration, calibration, read_calibration
from thermosplat.thermography.picture_structure import noise_of, opened, scatter_of, stands_out
from thermosplat.thermography.reprojection import (
    HIDDEN,
    camera_points,
    coarse_view,
    normals_of,
    pose_distances,
    sampled,
    seen_from,
)

Array = NDArray[np.float64]
_NEAREST, _LOOKED_AT = 8, 48
"""Training views that are compared with, and those of which it is asked whether they see a point."""
_MOST_CALIBRATING, _MOST_LEVELS = 12, 48
"""Held-out views that intervals are made of, and training views whose level is."""
FEW_VIEWS, GRAZING, REFLECTING, DEPTHS_DIFFER, SMALL, NO_SURFACE = (1 << bit for bit in range(6))
DOUBTS = {
    FEW_VIEWS: "fewer than two views saw it",
    GRAZING: "it was seen at grazing angles only",
    REFLECTING: "it changes with the direction, as reflections do",
    DEPTHS_DIFFER: "the spectra disagree about its depth",
    SMALL: "it is smaller than 3x3 pixels of the sensor",
    NO_SURFACE: "no surface is there",
}
"""Why a value should not be read."""
_FEWEST_VIEWS = 2
"""Without two of them nobody knows how far away it is."""
_LEAST_COSINE = 0.26
"""75° from straight on: emissivity of most surfaces falls beyond 60 to 70° (Minkina and Dudzik 2009)."""
_DEPTHS_APART = 0.05
"""Share of a depth by which the spectrum sees a surface before another spectrum's."""
_AGREES_LESS, _DISAGREES = 1.6, 1.5
"""Where spectra see different surfaces: how many times as much the other's images disagree at this one's depth as at
their own, and this one's images at the other's depth as is usual in the picture. Open choice, made on desk and lab."""
_POOLED = 1 / 16
"""Share of the picture's width over which they are compared."""
_TIMES_USUAL = 3.0
"""Times the noise, the drift, the slope, or the usual disagreement (the picture's median) from which on that of views
counts as a reflection."""


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
        self._last = b"", Sure(np.zeros((0, 0)), np.zeros((0, 0), np.uint8))  # several measurements are of one view

    @torch.no_grad()
    def of_view(self, view: ViewTensors, values: NDArray[np.floating]) -> Sure:
        """How sure the values of a view are.

        Args:
            view: From where they were rendered.
            values: What was rendered, [H, W], as the capture has it (not recalculated).
        """
        picture = (view.viewmat.cpu().numpy(), view.K.cpu().numpy(), np.asarray(values))
        key = hashlib.sha256(b"".join(map(np.ndarray.tobytes, picture))).digest()
        if key != self._last[0]:
            known = self.calibration
            s, doubts = self._evidence(view, values.astype(np.float64), known.noise, known.level)
            self._last = key, Sure(known.half_width(s), doubts)
        return self._last[1]

    @property
    def is_known(self) -> bool:
        """Whether the calibration is at hand; else it takes a while."""
        return self._calibration is not None or (self._keep is not None and read_calibration(self._keep) is not None)

    @property
    def calibration(self) -> Calibration:
        """What held-out views say; found when it is first asked for."""
        if self._calibration is None:
            known = None if self._keep is None else read_calibration(self._keep)
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
        looked_at = range(0, len(self._frames), max(1, len(self._frames) // _MOST_LEVELS))
        levels = np.array([self._level(index) for index in looked_at])
        level = float(np.std(levels))
        learnt = self._frames[:: max(1, len(self._frames) // _MOST_CALIBRATING)]
        noise = float(np.median([noise_of(self._measured_in(frame)[1].double().numpy(force=True)) for frame in learnt]))
        held_out = [frame for frame in frames if self.spectrum in frame.views]
        views = []
        for frame in held_out[:: max(1, len(held_out) // _MOST_CALIBRATING)]:
            view, rendered, expected = self._compared(frame)
            s, _ = self._evidence(view, rendered, noise, level)
            there = np.isfinite(s) & np.isfinite(expected)
            views.append((s[there], (rendered - expected)[there]))
        return calibration(noise, levels, views)

    def compared(self, frame: Frame, calibration: Calibration) -> tuple[Array, Array, NDArray[np.uint8]]:
        """Errors [H, W], halves of the intervals and doubts of a view that has an image."""
        view, rendered, expected = self._compared(frame)
        s, doubts = self._evidence(view, rendered, calibration.noise, calibration.level)
        return rendered - expected, calibration.half_width(s), doubts

    def _compared(self, frame: Frame) -> tuple[ViewTensors, Array, Array]:
        """A frame's view, and its values as they are rendered and as they were measured, [H, W]."""
        view, measured = self._measured_in(frame)
        return view, self._rendered(view), measured.double().cpu().numpy()

    def _rendered(self, view: ViewTensors) -> Array:
        image = self.model.render({self.spectrum: view}, sh_degree=self._sh_degree).images[self.spectrum]
        values: Array = self.scale.value(pixel_intensity(image.clamp(0, 1), self.scale)).double().cpu().numpy()
        return values

    def _level(self, index: int) -> float:
        """What the scene is wrong by in a training view as a whole."""
        camera, values, _ = self._taken(self.spectrum, index)
        return float(np.nanmedian(self._rendered(camera) - values[..., 0].double().cpu().numpy()))

    def _measured_in(self, frame: Frame) -> tuple[ViewTensors, Tensor]:
        view = view_tensors(frame.views[self.spectrum], None, self._device)
        return view, self._measured(view)

    def _measured(self, view: ViewTensors) -> Tensor:
        """Values of a photograph, [H, W]; within the range that a scene can show."""
        if view.values is not None:
            span = self.scale.range
            return view.values if span is None else view.values.clamp(*span)
        assert view.image is not None  # noqa: S101  a view of a capture
        values: Tensor = self.scale.value(pixel_intensity(view.image, self.scale))
        return values

    def _taken_anew(self, spectrum: str, index: int) -> tuple[ViewTensors, Tensor, Tensor]:
        """A training view in a spectrum, of a size that tells what is hidden: its camera, picture and depths."""
        view = view_tensors(self._frames[index].views[spectrum], None, self._device)
        camera, own = coarse_view(view), spectrum == self.spectrum
        shown = self._measured(view)[..., None] if own else view.image
        assert shown is not None  # noqa: S101  a view of a capture
        size = (camera.height, camera.width)
        picture = torch.nn.functional.interpolate(shown.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
        depth = self._surface(camera) if own else self.model.render_depth(spectrum, camera)
        return camera, picture, depth

    def _from_elsewhere(self, spectrum: str, index: int, view: ViewTensors, points: Tensor, deep: str) -> Tensor:
        """A training image as it looks from a view, [H, W, C]; NaN where it is hidden.

        Args:
            spectrum: The image's.
            index: The training frame.
            view: From where it is seen.
            points: What the view's pixels see, in its camera's axes, [H, W, 3].
            deep: The spectrum whose depths these are, which says what is hidden.
        """
        camera, picture, _ = self._taken(spectrum, index)
        positions, visible = self._seen_there(index, view, points, deep)
        if spectrum != deep:
            positions, _ = seen_from(camera, view, points)
        return torch.where(visible[..., None], sampled(picture, positions), torch.nan)

    def _seen_there(self, index: int, view: ViewTensors, points: Tensor, deep: str) -> tuple[Tensor, Tensor]:
        """Where points lie in a training image [px], and whether it shows them."""
        by, _, its_depth = self._taken(deep, index)
        positions, depths = seen_from(by, view, points)
        return positions, depths <= (1 + HIDDEN) * sampled(its_depth[..., None], positions)[..., 0]

    def _evidence(
        self, view: ViewTensors, values: Array, noise: float, level: float
    ) -> tuple[Array, NDArray[np.uint8]]:
        """s of each pixel, and its doubts."""
        of_each = {name: self.model.render_surface(name, view) for name in self.model.spectra}
        depth = self._surface(view, of_each)
        apart = pose_distances(self._poses, view.viewmat.cpu().numpy(), self._spacing)
        order = [int(index) for index in np.argsort(apart) if apart[index] > 1e-4][:_LOOKED_AT]
        normals = torch.stack([normals_of(one, view) for one, _ in of_each.values()], dim=2)  # any may be rough
        shown = torch.as_tensor(values, dtype=torch.float32, device=depth.device)
        points = camera_points(view, depth)
        nearest = [self._from_elsewhere(self.spectrum, one, view, points, self.spectrum) for one in order[:_NEAREST]]
        seen, facing = self._seen_well(view, points, normals, order)
        spread, scatter = np.zeros(values.shape), np.zeros(values.shape)
        if nearest:
            squares = (torch.stack(nearest)[..., 0] - shown).square().nanmean(dim=0)
            spread = squares.nan_to_num().sqrt().double().cpu().numpy()
            scatter = scatter_of(nearest)
        slope = np.hypot(*np.gradient(np.nan_to_num(values, nan=float(np.nanmedian(values)))))
        s = np.sqrt(noise**2 + level**2 + spread**2 + (slope / 2) ** 2)
        surface = (depth > 0).cpu().numpy() & np.isfinite(values)
        doubts = np.zeros(values.shape, np.uint8)
        few = opened((seen < _FEWEST_VIEWS).cpu().numpy())
        doubts[few] |= FEW_VIEWS
        doubts[opened(((facing < _LEAST_COSINE) & (seen > 0)).cpu().numpy())] |= GRAZING
        usual = float(np.median(scatter[surface])) if surface.any() else 0.0
        beside = cv2.dilate(slope, np.ones((3, 3), np.uint8))  # images lie a pixel aside at most
        doubts[opened(scatter > _TIMES_USUAL * np.hypot(beside, max(usual, noise, level)))] |= REFLECTING
        for other in of_each.keys() - {self.spectrum}:
            (_, solid), (theirs, there) = of_each[self.spectrum], of_each[other]
            doubts[self._lies_before(other, view, depth, theirs, solid & there, order)] |= DEPTHS_DIFFER
        focal = float(self._frames[order[0] if order else 0].views[self.spectrum].camera.K[0, 0])
        doubts[stands_out(values, noise, depth, view, focal)] |= SMALL
        doubts[~surface] = NO_SURFACE
        return np.where(surface, s, np.nan), doubts

    def _seen_well(
        self, view: ViewTensors, points: Tensor, normals: Tensor, order: Sequence[int]
    ) -> tuple[Tensor, Tensor]:
        """How many training images show a pixel's point, and the largest cosine to its normals, [H, W]; both at least
        what is enough where they are more: then no further image is asked."""
        shape, points, normals = points.shape[:2], points.flatten(0, 1), normals.flatten(0, 1)
        seen, facing = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
        left = torch.arange(len(points), device=points.device)
        for index in order:
            visible = self._seen_there(index, view, points[left, None], self.spectrum)[1][:, 0]
            towards = (view.viewmat @ self._taken(self.spectrum, index)[0].viewmat.inverse()[:, 3])[:3] - points[left]
            cosine = (towards[:, None] * normals[left]).sum(-1).abs().amax(1) / towards.norm(dim=-1).clamp(min=1e-9)
            seen[left] += visible
            facing[left] = torch.maximum(facing[left], torch.where(visible, cosine, 0.0))
            left = left[(seen[left] < _FEWEST_VIEWS) | (facing[left] < _LEAST_COSINE)]
            if not len(left):
                break
        return seen.view(shape), facing.view(shape)

    def _lies_before(
        self, other: str, view: ViewTensors, depth: Tensor, theirs: Tensor, both: Tensor, order: Sequence[int]
    ) -> NDArray[np.bool_]:
        """Where the spectrum sees a surface that another one looks through, [H, W].

        What the spectrum itself looks through, as films, is no such place: there it shows what lies behind.
        """
        before = opened((both & (depth > 0) & (theirs > (1 + _DEPTHS_APART) * depth)).cpu().numpy())
        near = [index for index in order if other in self._frames[index].views][:_NEAREST]
        if not before.any() or not near:
            return np.zeros_like(before)
        window = 2 * round(_POOLED * view.width / 2) + 1

        def scatter(spectrum: str, at: Tensor, deep: str) -> Array:
            return scatter_of([self._from_elsewhere(spectrum, index, view, at, deep) for index in near])

        def pooled(of_some: Array) -> Array:
            everywhere = np.zeros(before.shape)
            everywhere[before] = of_some**2
            share, sums = (cv2.blur(x, (window, window)) for x in (before.astype(np.float64), everywhere))
            return np.sqrt(np.maximum(sums, 0) / np.maximum(share, 1e-9))

        own, behind, mine = (
            camera_points(view, depth),
            camera_points(view, theirs),
            torch.from_numpy(before).to(depth.device),
        )
        at_own = pooled(scatter(other, own[mine][:, None], self.spectrum)[:, 0])
        at_theirs = pooled(scatter(other, behind[mine][:, None], other)[:, 0])
        told: NDArray[np.bool_] = before & (at_own > _AGREES_LESS * at_theirs)
        if told.any():
            thermal = scatter(self.spectrum, behind, other)
            told &= pooled(thermal[before]) > _DISAGREES * float(np.median(thermal))
        return told

    def _surface(self, view: ViewTensors, of_each: Mapping[str, tuple[Tensor, Tensor]] | None = None) -> Tensor:
        """Depth of what a view sees, [H, W].

        What is as cold as the range's lower end may be transparent in the spectrum: its depth there is another one's.
        ``of_each`` has the view's ``render_surface`` by spectrum; without it that is rendered where it is needed.
        """
        of_each = of_each or {}
        depth, solid = of_each.get(self.spectrum) or self.model.render_surface(self.spectrum, view)
        for other in self.model.spectra:
            if other != self.spectrum and not solid.all():
                theirs, there = of_each.get(other) or self.model.render_surface(other, view)
                depth = torch.where(~solid & there, theirs, depth)
        return depth
