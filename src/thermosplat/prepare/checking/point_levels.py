"""How the level of thermal images drifts, from sparse points that several images see.

A point that the photographs' model knows has one temperature T. Image f shows it as T + l_f, and the levels l_f are the
least squares solution over all points and images, with Huber's weights: reflections and hidden points bear little.
What the images show besides does not matter, so a flight over warm and cold ground is no drift.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.capture_folder import LEADING, OTHER
from thermosplat.prepare.registration.stereo_edges import sampled

MOST_POINTS = 20_000
"""Those that most photographs see. Open choice: their levels are exact to a hundredth of a degree."""
_LEAST_IMAGES = 3
_LEAST_POINTS = 20
"""Of an image; the levels of others are not told."""
_ROUNDS = 8
_HUBER = 1.345
"""Residuals, in standard deviations, from which on weights fall (Huber 1964)."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointLevels:
    """Levels of thermal images, against their mean.

    Args:
        levels: By file, in the images' unit.
        deviation: Standard deviation of one level, as the residuals say.
    """

    levels: Mapping[str, float]
    deviation: float
    points: int

    @property
    def drift(self) -> float:
        """Standard deviation of the levels over the images."""
        return float(np.std(list(self.levels.values())))


def point_levels(model: pycolmap.Reconstruction, images: Mapping[str, NDArray[Any]]) -> PointLevels | None:
    """The levels of thermal images.

    Args:
        model: The model of both cameras: photographs with points, and thermal images in their frames.
        images: Thermal images [H, W] by file.

    Returns:
        None where too few points are seen by several images.
    """
    seen = _seen(model, images)
    names = sorted({name for name, _, _ in seen})
    if len(names) < _LEAST_IMAGES:
        return None
    numbers = {name: number for number, name in enumerate(names)}
    frame = np.concatenate([np.full(len(ids), numbers[name]) for name, ids, _ in seen])
    point = np.concatenate([ids for _, ids, _ in seen])
    value = np.concatenate([values for _, _, values in seen])
    ids, point, counts = np.unique(point, return_inverse=True, return_counts=True)
    chosen = np.zeros(len(ids), bool)
    chosen[np.argsort(-counts, kind="stable")[:MOST_POINTS]] = True
    chosen &= counts >= _LEAST_IMAGES
    kept = chosen[point]
    frame, value = frame[kept], value[kept]
    point = (np.cumsum(chosen) - 1)[point[kept]]
    if not len(value) or np.bincount(frame, minlength=len(names)).min() < _LEAST_POINTS:
        return None
    levels, deviation = _solved(frame, point, value, len(names), int(chosen.sum()))
    return PointLevels(dict(zip(names, levels.tolist())), deviation, int(chosen.sum()))


def _seen(
    model: pycolmap.Reconstruction, images: Mapping[str, NDArray[Any]]
) -> list[tuple[str, NDArray[np.int64], Array]]:
    """By thermal image: the points that its photograph sees, and their values in the thermal image."""
    photographs = {image.frame_id: image for image in model.images.values() if image.name.startswith(f"{LEADING}/")}
    found = []
    for _, image in sorted(model.images.items()):
        name, photograph = image.name.removeprefix(f"{OTHER}/"), photographs.get(image.frame_id)
        if name not in images or photograph is None or not image.has_pose:
            continue
        ids = np.array([one.point3D_id for one in photograph.get_observation_points2D()], np.int64)
        if not len(ids):
            continue
        places = np.array([model.points3D[int(one)].xyz for one in ids])
        pose = image.cam_from_world().matrix()
        local = places @ pose[:, :3].T + pose[:, 3]
        ahead = local[:, 2] > 0
        pixels = np.full((len(ids), 2), -1.0)
        pixels[ahead] = np.nan_to_num(np.asarray(model.cameras[image.camera_id].img_from_cam(local[ahead])), nan=-1.0)
        height, width = images[name].shape[:2]
        inside = ((pixels > 1) & (pixels < [width - 1, height - 1])).all(axis=1)
        values = sampled(images[name].astype(np.float32), pixels[inside] - 0.5)
        found.append((name, ids[inside], values.astype(np.float64)))
    return found


def _solved(
    frame: NDArray[np.intp], point: NDArray[np.intp], value: Array, frames: int, points: int
) -> tuple[Array, float]:
    """Levels [frames] and the standard deviation of one, by weighted least squares; temperatures are eliminated."""
    weights, levels, scale = np.ones(len(value)), np.zeros(frames), 1.0
    normal: Array = np.eye(frames)
    for _ in range(_ROUNDS):
        table = np.zeros((points, frames), np.float32)
        table[point, frame] = weights
        per_point = np.maximum(np.bincount(point, weights, points), 1e-9)
        per_frame = np.bincount(frame, weights, frames)
        shared = table.T @ (table / per_point[:, None].astype(np.float32))
        normal = np.asarray(np.diag(per_frame) - shared, np.float64)
        means = np.bincount(point, weights * value, points) / per_point
        right = np.bincount(frame, weights * (value - means[point]), frames)
        levels = np.asarray(np.linalg.lstsq(normal, right, rcond=1e-6)[0], np.float64)
        levels -= levels.mean()
        temperatures = np.bincount(point, weights * (value - levels[frame]), points) / per_point
        residuals = value - levels[frame] - temperatures[point]
        scale = max(1.4826 * float(np.median(np.abs(residuals))), 1e-9)
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residuals), 1e-12))
    covariance = np.linalg.pinv(normal, rcond=1e-6, hermitian=True)
    return levels, float(scale * np.sqrt(np.mean(np.diag(covariance))))
