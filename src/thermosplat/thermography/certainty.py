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
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.errors import UserError
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.runs.atomic_writes import write_text
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.calibration import Calibration, calibration, read_calibration
from thermosplat.thermography.picture_structure import noise_of, opened, scatter_of, stands_out
from thermosplat.thermography.reprojection import camera_points, normals_of, pose_distances
from thermosplat.thermography.training_images import Surfaces, TrainingImages, surface_of

Array = NDArray[np.float64]
_NEAREST, _LOOKED_AT = 8, 48
"""Training views that are compared with, and those of which it is asked whether they see a point."""
_MOST_CALIBRATING, _MOST_LEVELS = 12, 48
"""Held-out views that intervals are made of, and training views whose level is."""
_MOST_LOOKS = 32
"""Views that are remembered: a report asks of some again and again."""
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
    """Why a value should not be read, bits of ``DOUBTS``, [H, W]; 0: it may be, or nobody asked."""


@dataclass(frozen=True, eq=False)
class Look:
    """What a view and the training images nearest to it say of its values, all [H, W]."""

    surfaces: Mapping[str, tuple[Tensor, Tensor]]
    """By spectrum, as of ``render_surface``."""
    depth: Tensor
    nearest: Sequence[int]  # training views by how far they were taken from it
    s: Array
    """NaN where there is no surface."""
    surface: NDArray[np.bool_]
    """Where a value is on a surface."""
    slope: Array
    """Of the values, in their unit per pixel."""
    scatter: Array
    """Of the nearest images, as of ``scatter_of``."""


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

    Attributes:
        frames: The training frames that have the spectrum; ``images`` holds their images.
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
        self.frames = [frame for frame in capture.train if spectrum in frame.views]
        if not self.frames:
            raise UserError(f"{capture.root} has no {spectrum} images to compare with.")
        self._poses = np.stack([frame.views[spectrum].viewmat for frame in self.frames])
        places = np.linalg.inv(self._poses)[:, :3, 3]
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        self._spacing = float(np.median(apart.min(axis=1))) if len(places) > 1 else 1.0
        self.images = TrainingImages(model, self.frames, spectrum, scale, device)
        self._calibration: Calibration | None = None
        self._last = b"", Sure(np.zeros((0, 0)), np.zeros((0, 0), np.uint8))  # several measurements are of one view
        self._looks: dict[bytes, Look] = {}

    @torch.no_grad()
    def of_view(self, view: ViewTensors, values: NDArray[np.floating], where: NDArray[np.bool_] | None = None) -> Sure:
        """How sure the values of a view are.

        Args:
            view: From where they were rendered.
            values: What was rendered, [H, W], as the capture has it (not recalculated).
            where: Pixels whose doubts are asked for, [H, W], which are sooner told if they are few; None: all.
        """
        picture = (view.viewmat.cpu().numpy(), view.K.cpu().numpy(), np.asarray(values))
        key = hashlib.sha256(b"".join(map(np.ndarray.tobytes, picture))).digest()
        asked = key if where is None else key + where.tobytes()
        if asked != self._last[0]:
            known, shown = self.calibration, values.astype(np.float64)
            look = self._looks.pop(key, None) or self.look_of(view, shown, known.noise, known.level)
            if where is not None:  # by a report, in small pictures
                self._looks = dict([*self._looks.items(), (key, look)][-_MOST_LOOKS:])
            doubts = self.doubts_of(view, shown, look, known.noise, known.level, where)
            self._last = asked, Sure(known.half_width(look.s), doubts)
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
            self._calibration = known or self.calibrated(list(self.capture.test) or self.frames)
            if known is None and self._keep is not None:
                write_text(self._keep, json.dumps(asdict(self._calibration)) + "\n")
        return self._calibration

    @torch.no_grad()
    def calibrated(self, frames: list[Frame]) -> Calibration:
        """What some views say of the scene's temperatures.

        Args:
            frames: Views that the scene was not trained on.
        """
        levels = np.array([self._level(index) for index in evenly_chosen(range(len(self.frames)), _MOST_LEVELS)])
        level = float(np.std(levels))
        learnt = self.frames[:: max(1, len(self.frames) // _MOST_CALIBRATING)]
        noise = float(np.median([noise_of(self._measured_in(frame)[1].double().numpy(force=True)) for frame in learnt]))
        held_out = [frame for frame in frames if self.spectrum in frame.views]
        views = []
        for frame in held_out[:: max(1, len(held_out) // _MOST_CALIBRATING)]:
            view, rendered, expected = self._compared(frame)
            s = self.look_of(view, rendered, noise, level).s
            there = np.isfinite(s) & np.isfinite(expected)
            views.append((s[there], (rendered - expected)[there]))
        return calibration(noise, levels, views)

    def compared(self, frame: Frame, calibration: Calibration) -> tuple[Array, Array, NDArray[np.uint8]]:
        """Errors [H, W], halves of the intervals and doubts of a view that has an image."""
        view, rendered, expected = self._compared(frame)
        look = self.look_of(view, rendered, calibration.noise, calibration.level)
        doubts = self.doubts_of(view, rendered, look, calibration.noise, calibration.level)
        return rendered - expected, calibration.half_width(look.s), doubts

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
        camera, values = self.images.camera(self.spectrum, index), self.images.picture(self.spectrum, index)
        return float(np.nanmedian(self._rendered(camera) - values[..., 0].double().cpu().numpy()))

    def _measured_in(self, frame: Frame) -> tuple[ViewTensors, Tensor]:
        view = view_tensors(frame.views[self.spectrum], None, self._device)
        return view, self.images.measured(view)

    def _nearest(self, view: ViewTensors) -> list[int]:
        """Training views by how far they were taken from a view, without itself."""
        apart = pose_distances(self._poses, view.viewmat.cpu().numpy(), self._spacing)
        return [int(index) for index in np.argsort(apart) if apart[index] > 1e-4][:_LOOKED_AT]

    def look_of(self, view: ViewTensors, values: Array, noise: float, level: float) -> Look:
        """How wrong a picture's values [H, W] may be, by the noise of the sensor and the level's spread."""
        own, surfaces = self.spectrum, Surfaces(self.model, view)
        depth, order = surface_of(own, surfaces), self._nearest(view)
        shown = torch.as_tensor(values, dtype=torch.float32, device=depth.device)
        points = camera_points(view, depth)
        nearest = [self.images.seen_from(own, one, view, points, own) for one in order[:_NEAREST]]
        spread, scatter = np.zeros(values.shape), np.zeros(values.shape)
        if nearest:
            squares = (torch.stack(nearest)[..., 0] - shown).square().nanmean(dim=0)
            spread = squares.nan_to_num().sqrt().double().cpu().numpy()
            scatter = scatter_of(nearest)
        slope = np.hypot(*np.gradient(np.nan_to_num(values, nan=float(np.nanmedian(values)))))
        s = np.sqrt(noise**2 + level**2 + spread**2 + (slope / 2) ** 2)
        surface = (depth > 0).cpu().numpy() & np.isfinite(values)
        return Look(surfaces, depth, order, np.where(surface, s, np.nan), surface, slope, scatter)

    def doubts_of(
        self,
        view: ViewTensors,
        values: Array,
        look: Look,
        noise: float,
        level: float,
        where: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.uint8]:
        """Why values [H, W] should not be read; arguments as of ``of_view`` and ``look_of``."""
        where = np.ones(values.shape, bool) if where is None else where
        depth, surfaces, order = look.depth, look.surfaces, look.nearest
        normals = [normals_of(surfaces[name][0], view) for name in self.model.spectra]  # any may be rough
        seen, facing = self._seen_well(view, camera_points(view, depth), torch.stack(normals, dim=2), order, where)
        doubts = np.zeros(values.shape, np.uint8)
        few = opened((seen < _FEWEST_VIEWS).cpu().numpy())
        doubts[few] |= FEW_VIEWS
        doubts[opened(((facing < _LEAST_COSINE) & (seen > 0)).cpu().numpy())] |= GRAZING
        scatter, surface = look.scatter, look.surface
        usual = float(np.median(scatter[surface])) if surface.any() else 0.0
        beside = cv2.dilate(look.slope, np.ones((3, 3), np.uint8))  # images lie a pixel aside at most
        doubts[opened(scatter > _TIMES_USUAL * np.hypot(beside, max(usual, noise, level)))] |= REFLECTING
        for other in set(self.model.spectra) - {self.spectrum}:
            (_, solid), (theirs, there) = surfaces[self.spectrum], surfaces[other]
            doubts[self.lies_before(other, view, depth, theirs, solid & there, order, where)] |= DEPTHS_DIFFER
        focal = float(self.frames[order[0] if order else 0].views[self.spectrum].camera.K[0, 0])
        doubts[stands_out(values, noise, depth, view, focal)] |= SMALL
        doubts[~surface] = NO_SURFACE
        return doubts

    def _seen_well(
        self, view: ViewTensors, points: Tensor, normals: Tensor, order: Sequence[int], where: NDArray[np.bool_]
    ) -> tuple[Tensor, Tensor]:
        """How many training images show a pixel's point, and the largest cosine to its normals, [H, W].

        Both are at least what is enough where that is so, and where a pixel is in no square of ``opened`` that lacks it
        and has a pixel that is asked for: then no further image is asked. So the order does not matter, and images come
        first whose depths are there.
        """
        near = torch.from_numpy(cv2.dilate(where.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0).to(points.device)
        shape, points, normals = points.shape[:2], points.flatten(0, 1), normals.flatten(0, 1)
        facing = torch.where(near.flatten(), 0.0, 1.0)
        seen, left, own = _FEWEST_VIEWS * facing, near.flatten().nonzero()[:, 0], self.spectrum
        for index in sorted(order, key=lambda index: not self.images.knows_depth(own, index)):
            visible = self.images.shown(index, view, points[left, None], own)[1][:, 0]
            eye = self.images.camera(own, index).viewmat.inverse()[:, 3]
            towards = (view.viewmat @ eye)[:3] - points[left]
            cosine = (towards[:, None] * normals[left]).sum(-1).abs().amax(1) / towards.norm(dim=-1).clamp(min=1e-9)
            seen[left] += visible
            facing[left] = torch.maximum(facing[left], torch.where(visible, cosine, 0.0))
            lacking = ((seen < _FEWEST_VIEWS) | (facing < _LEAST_COSINE)).view(shape)
            wide = torch.from_numpy(opened(lacking.cpu().numpy())).to(points.device)
            narrow = (lacking & ~wide).flatten()
            seen[narrow], facing[narrow] = _FEWEST_VIEWS, 1.0
            left = wide.flatten().nonzero()[:, 0]
            if not len(left):
                break
        return seen.view(shape), facing.view(shape)

    def lies_before(
        self,
        other: str,
        view: ViewTensors,
        depth: Tensor,
        theirs: Tensor,
        both: Tensor,
        order: Sequence[int],
        where: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Where the spectrum sees a surface that another one looks through, [H, W], of the pixels that are asked for.

        What the spectrum itself looks through, as films, is no such place: there it shows what lies behind.
        """
        before = opened((both & (depth > 0) & (theirs > (1 + _DEPTHS_APART) * depth)).cpu().numpy())
        near = [index for index in order if other in self.frames[index].views][:_NEAREST]
        if not (before & where).any() or not near:
            return np.zeros_like(before)
        window = 2 * round(_POOLED * view.width / 2) + 1
        before &= cv2.dilate(where.astype(np.uint8), np.ones((window, window), np.uint8)) > 0  # all that is pooled

        def scatter(spectrum: str, at: Tensor, deep: str) -> Array:
            return scatter_of([self.images.seen_from(spectrum, index, view, at, deep) for index in near])

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
        told: NDArray[np.bool_] = before & where & (at_own > _AGREES_LESS * at_theirs)
        if told.any():
            thermal = scatter(self.spectrum, behind, other)
            told &= pooled(thermal[before]) > _DISAGREES * float(np.median(thermal))
        return told
