"""Whether photographs show what their poses say: sparse points have the colours of the pixels that they fall on.

COLMAP's points have the mean colour of the photographs that see them. Projected into a photograph, their brightness
goes with that of its pixels; what hides a point lowers the correlation and does not end it. The same correlation of
photographs with poses of others is subtracted, so that a bright sky over dark ground does not count. Poses read in
another way, of neighbours in the list, or with another focal length are tried too: where these explain the photographs
better, the sentence says which.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.checking.sensor_orientation import LUMA

_COMPARED = 16
"""Photographs that are looked at."""
_LEAST_FRAMES, _LEAST_POINTS = 8, 100
_MOST_POINTS = 4000
_LONG_SIDE = 320
"""Of the photographs that are looked at [px]."""
_AGREE = 0.15
"""Correlation below which photographs and points have nothing in common. Open choice: eight good captures have 0.34 to
0.72, desk with its poses inverted, shuffled or shifted by a frame at most 0.10."""
_BETTER = 0.08
"""By how much another reading of the poses has to explain the photographs better. Open choice."""
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_REMEDIES = {
    "inverted": "the poses are inverted (camera to world in the place of world to camera, or the other way round)",
    "axes": "the poses have OpenGL's axes where OpenCV's are expected, or the other way round",
    "wide": "focal lengths are twice as long as they should be",
    "long": "focal lengths are half as long as they should be",
}

Array = NDArray[np.float64]


def pose_notes(views: Sequence[View], points: NDArray[np.floating], colors: NDArray[np.uint8]) -> list[str]:
    """A sentence (none or one) on photographs that do not show what their poses say.

    Args:
        views: Photographs in the order of their names.
        points: Sparse points [M, 3] [world units].
        colors: Their colours [M, 3].
    """
    scores = pose_scores(views, points, colors)
    if not scores:
        return []
    stated = scores["stated"]
    best = max(scores, key=lambda name: scores[name])
    if best != "stated" and scores[best] > max(_AGREE, stated + _BETTER):
        moved = f"each pose is that of the photograph {best} places on in the order of names"
        why = f": it looks as if {_REMEDIES.get(best, moved)}"
    elif stated < _AGREE:
        why = ": they may be the poses of other images, or of another capture"
    else:
        return []
    return [
        f"Photographs do not show what their poses say (the brightness of sparse points agrees to {stated:.0%}){why}. "
        "Correct the poses, or find them anew: colmap automatic_reconstructor, or thermosplat-prepare sfm."
    ]


def pose_scores(views: Sequence[View], points: NDArray[np.floating], colors: NDArray[np.uint8]) -> Mapping[str, float]:
    """How well points and photographs agree (at most 1), by how the poses are read; empty where nothing can be said."""
    if len(views) < _LEAST_FRAMES or len(points) < _LEAST_POINTS or np.ptp(colors.astype(int) @ [1, 1, 1]) == 0:
        return {}
    every = max(1, len(points) // _MOST_POINTS)
    places, luma = points[::every].astype(np.float64), colors[::every].astype(np.float32) @ LUMA
    at = evenly_chosen(range(len(views)), _COMPARED)
    cache: dict[int, NDArray[np.float32]] = {}

    def image(place: int) -> NDArray[np.float32]:
        place %= len(views)
        if place not in cache:
            cache[place] = reduced_luma(views[place])
        return cache[place]

    def score(shift: int = 0, focal: float = 1.0, inverted: bool = False, axes: bool = False) -> float:
        found = []
        for place in at:
            view = views[place]
            pose = np.asarray(np.linalg.inv(view.viewmat) if inverted else view.viewmat, np.float64)
            pose = _AXES @ pose if axes else pose
            pixels, inside = projected(view, pose, focal, places)
            true = _agreement(image(place + shift), pixels, luma[inside])
            wrong = _agreement(image(place + shift + len(views) // 2), pixels, luma[inside])
            found.append(true - max(wrong, 0.0))
        return float(np.mean(found))

    readings = {"stated": score(), "inverted": score(inverted=True), "axes": score(axes=True)}
    readings |= {"wide": score(focal=0.5), "long": score(focal=2.0)}
    return readings | {f"{shift:+d}": score(shift) for shift in (-2, -1, 1, 2)}


def projected(view: View, pose: Array, focal: float, places: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where points fall in an image.

    Args:
        pose: [4, 4], world to camera, in the place of its own.
        places: Points [M, 3] [world units].

    Returns:
        Pixels [N, 2] of those in the image, as shares of its sides, and which of the points these are.
    """
    local = places @ pose[:3, :3].T + pose[:3, 3]
    camera = view.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (focal * camera.fx * local[:, 0] / local[:, 2] + camera.cx) / camera.width
        y = (focal * camera.fy * local[:, 1] / local[:, 2] + camera.cy) / camera.height
        inside = (local[:, 2] > 1e-6) & (x > 0) & (x < 1) & (y > 0) & (y < 1)
    return np.stack([x, y], 1)[inside], inside


def _agreement(image: NDArray[np.float32], shares: Array, luma: NDArray[np.float32]) -> float:
    """Correlation of the points' brightness with the image's; 0 for too few of them."""
    if len(shares) < _LEAST_POINTS // 5:
        return 0.0
    seen = _sampled(image, shares)
    if seen.std() < 1 or luma.std() < 1:
        return 0.0
    return float(np.corrcoef(seen, luma)[0, 1])


def _sampled(image: NDArray[np.float32], shares: Array) -> NDArray[np.float32]:
    at = (shares * image.shape[1::-1] - 0.5).astype(np.float32)
    seen = cv2.remap(image, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen[0], np.float32)


def unseen_share(views: Sequence[View], points: NDArray[np.floating]) -> float:
    """Share of the points that lie in none of the images, before the cameras of some of them.

    Args:
        points: Sparse points [M, 3] [world units].
    """
    places = points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)
    seen = np.zeros(len(places), bool)
    for view in views[:: max(1, len(views) // (4 * _COMPARED))]:
        seen |= projected(view, view.viewmat, 1.0, places)[1]
    return float(1 - seen.mean())


def exposure_drift(views: Sequence[View], points: NDArray[np.floating], colors: NDArray[np.uint8]) -> float:
    """Standard deviation of the photographs' brightness, as a share, where they show the same points.

    Args:
        views: Photographs whose poses are right, in the order of their names.
        points: Sparse points [M, 3] [world units].
        colors: Their colours [M, 3], which are the mean of what photographs show.
    """
    every = max(1, len(points) // _MOST_POINTS)
    places, luma = points[::every].astype(np.float64), colors[::every].astype(np.float32) @ LUMA
    gains = []
    for view in views[:: max(1, len(views) // (2 * _COMPARED))]:
        shares, inside = projected(view, view.viewmat, 1.0, places)
        if len(shares) >= _LEAST_POINTS // 5:
            ratios = (_sampled(reduced_luma(view), shares) + 8) / (luma[inside] + 8)  # dark pixels tell little
            gains.append(float(np.log(np.median(ratios))))
    return float(np.std(gains)) if len(gains) >= _LEAST_FRAMES else 0.0


def reduced_luma(view: View, long_side: int = _LONG_SIDE) -> NDArray[np.float32]:
    """Brightness of a photograph, [H, W] from 0 to 255, with sides of at most ``long_side`` px."""
    image = view.pixels().image
    factor = min(1.0, long_side / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small.astype(np.float32) @ LUMA)
