"""One frame for the scenes of two dates: what photographs of both show, taken to space by each scene's own depth.

SIFT descriptors of a photograph of one date are looked for in one of the other (Lowe 2004: ratio of the two nearest).
Both scenes say how deep the two points lie, so a match is a pair of points in space. A similarity that many pairs of
two photographs agree on proves that they show the same thing (LO-RANSAC, pycolmap). All pairs that do so give the
similarity between the scenes, by Tukey's weights.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, View
from thermosplat.datasets.colmap.similarity import ransac_similarity, similarity_by_weights
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import LoadedRun
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.thermography.reprojection import coarse_view, resized, scene_points

Array = NDArray[np.float64]
_MOST_VIEWS, _NEAREST = 48, 6
"""Photographs of each date, and of how many of the other date each is looked for where positions say which are near."""
_FEATURES = 1500
_SIDE = 1200
"""Longer side [px] of photographs in which features are looked for."""
_RATIO = 0.8
"""Of the distances to the nearest and the second nearest descriptor (Lowe 2004)."""
_WITHIN = 0.01
"""Share of the depth by which two points may miss each other; a trained scene's depth is good to a few thousandths."""
_FEWEST = 12
"""Matches that agree, below which two photographs show nothing in common."""
_FEWEST_TOGETHER = 60
_TRIALS_OF_TWO, _TRIALS_OF_ALL = (200, 3000), (500, 5000)
"""The fewest and the most similarities that are tried for two photographs, and for all."""
_ROUNDS = 20
_TUKEY = 4.7
"""Robust standard deviations beyond which a pair has no weight (Holland and Welsch 1977)."""
_NEIGHBOURHOOD = 0.02
"""Share by which depths around a point may differ: at outlines a point has none."""


@dataclass(frozen=True, eq=False)
class SharedFrame:
    """How the scene of another date lies in that of the first."""

    to_first: MapFrame
    """From its scene to the first's."""
    residual: float
    """Median distance of matched points, in units of the first scene."""
    matches: int
    """Matched points that agree."""


@dataclass(frozen=True, eq=False)
class _Features:
    """Features of one photograph whose depth is known."""

    descriptors: NDArray[np.float32]
    points: Array
    depth: float
    place: Array


def shared_frame(
    first: tuple[LoadedRun, Capture],
    other: tuple[LoadedRun, Capture],
    spectrum: str,
    start: MapFrame | None = None,
) -> SharedFrame:
    """Find where the scene of another date lies in the first.

    Args:
        spectrum: Photographs that both have.
        start: About where the other scene lies in the first, by GPS; it only tells which photographs are near.

    Raises:
        UserError: Their photographs show nothing in common.
    """
    ours, theirs = (list(_features(run, capture, spectrum)) for run, capture in (first, other))
    source, target, depth = [], [], []
    for one, two in _candidates(ours, theirs, start):
        near, far = matched(one.descriptors, two.descriptors)
        if len(near) < _FEWEST:
            continue
        alike = agreeing(two.points[far], one.points[near], _WITHIN * one.depth)
        if alike.sum() >= _FEWEST:
            source.append(two.points[far][alike])
            target.append(one.points[near][alike])
            depth.append(np.full(int(alike.sum()), one.depth))
    if sum(map(len, source)) < _FEWEST_TOGETHER:
        raise UserError(
            f"The photographs of {other[0].directory.path} and {first[0].directory.path} show nothing in common, so "
            "there is no frame in which both scenes lie.",
            "Are they of the same place, by about the same light and season? Compare two runs of one place.",
        )
    return together(np.concatenate(source), np.concatenate(target), np.concatenate(depth))


@torch.no_grad()
def _features(run: LoadedRun, capture: Capture, spectrum: str) -> Iterator[_Features]:
    """Features of some photographs, evenly chosen."""
    views = [frame.views[spectrum] for frame in (*capture.train, *capture.test) if spectrum in frame.views]
    for view in evenly_chosen(views, _MOST_VIEWS):
        yield _features_of(run, view, spectrum)


def _features_of(run: LoadedRun, view: View, spectrum: str) -> _Features:
    tensors = view_tensors(view, None, run.device).as_pinhole()
    assert tensors.image is not None  # noqa: S101  a view of a capture
    image = (tensors.image.float().mean(dim=-1).cpu().numpy() * 255).clip(0, 255).astype(np.uint8)
    shrink = min(1.0, _SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(small, None)
    coarse = coarse_view(resized(tensors, tensors.width, tensors.height))
    depth = run.model.render_depth(spectrum, coarse)
    points = scene_points(coarse, depth).double().cpu().numpy()
    known, rough = depth.cpu().numpy(), _rough(depth.cpu().numpy())
    place = np.asarray(np.linalg.inv(view.viewmat)[:3, 3], np.float64)
    if descriptors is None:
        return _Features(np.zeros((0, 128), np.float32), np.zeros((0, 3)), 1.0, place)
    factor = np.array([coarse.width / small.shape[1], coarse.height / small.shape[0]])
    at = (np.array([point.pt for point in keypoints]) + 0.5) * factor
    x, y = (np.clip(at[:, axis].astype(int), 0, size - 1) for axis, size in enumerate((coarse.width, coarse.height)))
    kept = (known[y, x] > 0) & ~rough[y, x]
    unit = descriptors / np.maximum(
        np.abs(descriptors).sum(axis=1, keepdims=True), 1e-9
    )  # RootSIFT (Arandjelović 2012)
    centre = (np.stack([x, y], axis=1) + 0.5)[kept]
    aside = (at[kept] - centre)[:, :, None] * _slopes(points)[y[kept], x[kept]]
    found = points[y, x][kept] + aside.sum(axis=1)
    middle = float(np.median(known[known > 0])) if (known > 0).any() else 1.0
    return _Features(np.sqrt(unit[kept]), found, middle, place)


def _rough(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where depths around a pixel differ, or are not known."""
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, around), cv2.dilate(depth, around)
    return (low <= 0) | (high - low > _NEIGHBOURHOOD * np.maximum(low, 1e-9))


def _slopes(points: Array) -> Array:
    """How a picture's points [H, W, 3] change by a pixel to the right and downwards, [H, W, 2, 3]."""
    down, right = np.gradient(points, axis=(0, 1))
    return np.stack([right, down], axis=2)


def _candidates(
    ours: list[_Features], theirs: list[_Features], start: MapFrame | None
) -> Iterator[tuple[_Features, _Features]]:
    """Photographs that may show the same: all of them, or where places are known the nearest."""
    if start is None:
        yield from ((one, two) for two in theirs for one in ours)
        return
    places = np.stack([one.place for one in ours])
    for two in theirs:
        apart = np.linalg.norm(places - start.to_map(two.place), axis=1)
        yield from ((ours[number], two) for number in np.argsort(apart)[:_NEAREST])


def matched(ours: NDArray[np.float32], theirs: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which descriptors of two photographs are each other's nearest, and clearly nearer than the second."""
    if len(ours) < 2 or len(theirs) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    alike = theirs @ ours.T  # of unit length: the distance is sqrt(2 - 2 alike)
    best = alike.argmax(axis=1)
    rows = np.arange(len(theirs))
    first = alike[rows, best]
    back = alike.argmax(axis=0)
    alike[rows, best] = -np.inf
    second = alike.max(axis=1)
    clear = (1 - first) < _RATIO**2 * (1 - second)
    kept = clear & (back[best] == rows)
    return best[kept], rows[kept]


def agreeing(source: Array, target: Array, within: float) -> NDArray[np.bool_]:
    """Pairs of points that one similarity brings together."""
    matrix = ransac_similarity(source, target, within, _TRIALS_OF_TWO)
    if matrix is None:
        return np.zeros(len(source), bool)
    return np.asarray(np.linalg.norm(source @ matrix[:, :3].T + matrix[:, 3] - target, axis=1) < within)


def together(source: Array, target: Array, depth: Array) -> SharedFrame:
    """The similarity of all pairs; those of photographs that were fooled have no weight in the end."""
    start = ransac_similarity(source, target, _WITHIN * float(np.median(depth)), _TRIALS_OF_ALL)
    matrix = np.eye(4)[:3] if start is None else start

    def apart() -> Array:
        return np.asarray(np.linalg.norm(source @ matrix[:, :3].T + matrix[:, 3] - target, axis=1) / depth)

    for _ in range(_ROUNDS):
        distances = apart()
        far = distances / (_TUKEY * max(float(np.median(distances)), 1e-9) / 1.538)  # the median of three dimensions
        matrix = similarity_by_weights(source, target, np.where(far < 1, (1 - far**2) ** 2, 0.0) / depth**2)
    kept = far < 1
    residual = float(np.median((apart() * depth)[kept]))
    return SharedFrame(MapFrame.of_similarity(matrix), residual, int(kept.sum()))
