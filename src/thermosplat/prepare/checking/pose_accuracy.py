"""How exact the poses of photographs are: what two photographs both show lies where their poses say, or beside it.

Points that two photographs share are matched, and of these matches those that any relative pose explains are kept
(essential matrix by RANSAC; Hartley and Zisserman, Multiple View Geometry, 2004, section 9.6). The stated poses should
explain them as well: the distance is Sampson's, to first order that of the matches to what agrees with the poses (the
same, section 11.4.3). Cameras that only turned have no epipolar lines; any direction of motion then explains matches
that the rotation explains.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.checking.posed_photographs import reduced_luma

LONG_SIDE = 640
"""Of the photographs that are looked at, and the unit of distances [px]."""
MOST_REFINED = 8.0
"""Distance of matches [px] up to which training finds poses. Open choice: that of poses off by some 4°."""
_COMPARED = 16
_FEATURES = 1000
_LEAST_PAIRS = 6
_LEAST_MATCHES = 25
_RATIO = 0.75
"""Distance of the best match beside the second one (Lowe, 2004, has 0.8)."""
_TOLERANCE = 1.5
"""Of a match that a relative pose explains [px]."""
_NEAR_ANGLE = 45.0
"""Angle between two cameras [°] that counts as much as the distance of most cameras: of all, the nearest is taken."""
_INEXACT = 0.5
"""Distance of matches [px] from which poses are inexact. Open choice: 20 good captures have 0.06 to 0.23, with every
third photograph blurred up to 0.33, with poses off by 0.5° 0.61 to 1.11 (benchmarks/records/real-captures.md)."""
_TIMES_FITTED = 2.5
"""... and so many times the distance that a relative pose of their own leaves, so that blur is none. Open choice: good
captures have 0.4 to 1.3, with poses off by 0.5° 4.6 to 6.1."""

Array = NDArray[np.float64]


class PoseAccuracy(NamedTuple):
    """What matches of photographs say of their poses; medians over pairs of the pairs' medians."""

    stated: float
    """Distance of matches from the stated poses [px of images whose longer side has ``LONG_SIDE``]."""
    fitted: float
    """The same from the relative pose that explains most of them."""

    @property
    def inexact(self) -> bool:
        """Whether poses that are corrected would explain the photographs better."""
        return self.stated > max(_INEXACT, _TIMES_FITTED * self.fitted)


class _Features(NamedTuple):
    rays: Array
    """Of the features, [N, 2], x/z and y/z in the camera."""
    descriptors: NDArray[np.float32]
    pixel: float
    """Size of a pixel of the reduced image on the plane z = 1."""


def pose_accuracy(views: Sequence[View]) -> PoseAccuracy | None:
    """How far photographs are from showing what their poses say.

    Returns:
        Distances; None where too few photographs share enough, or a lens is in the way.
    """
    if any(view.camera.lens is not None or view.camera.distortion is not None for view in views):
        return None
    features: dict[int, _Features] = {}
    found = []
    for first in evenly_chosen(range(len(views)), _COMPARED):
        second = _nearest(views, first)
        if second is None:
            continue
        for place in (first, second):
            if place not in features:
                features[place] = _features(views[place])
        relative = views[second].viewmat @ np.linalg.inv(views[first].viewmat)
        distances = _distances(features[first], features[second], relative)
        if distances is not None:
            found.append(distances)
    return PoseAccuracy(*np.median(found, axis=0).tolist()) if len(found) >= _LEAST_PAIRS else None


def _nearest(views: Sequence[View], place: int) -> int | None:
    """The view whose camera stands and looks most alike."""
    if len(views) < 2:
        return None
    poses = np.array([view.viewmat for view in views], np.float64)
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    apart = np.linalg.norm(centers - centers[place], axis=1)
    angles = np.degrees(np.arccos(np.clip(poses[:, 2, :3] @ poses[place, 2, :3], -1.0, 1.0)))
    cost = apart / max(float(np.median(apart)), 1e-12) + angles / _NEAR_ANGLE
    cost[place] = np.inf
    return int(cost.argmin())


def _features(view: View) -> _Features:
    camera, small = view.camera, np.rint(reduced_luma(view, LONG_SIDE)).astype(np.uint8)
    keypoints, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(small, None)
    at = np.array([point.pt for point in keypoints], np.float64).reshape(-1, 2) + 0.5
    at *= np.array([camera.width / small.shape[1], camera.height / small.shape[0]])
    rays = (at - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    found = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
    return _Features(rays, found, camera.width / small.shape[1] / camera.fx)


def _distances(first: _Features, second: _Features, relative: Array) -> tuple[float, float] | None:
    """Median distances of the matches of two photographs from the stated and from a fitted relative pose [px].

    Args:
        relative: [4, 4], from the first camera to the second one.
    """
    one, other = _matched(first, second)
    if len(one) < _LEAST_MATCHES:
        return None
    pixel = first.pixel
    fitted, mask = cv2.findEssentialMat(
        one, other, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.999, threshold=_TOLERANCE * pixel
    )
    if fitted is None or fitted.shape != (3, 3) or (kept := mask[:, 0] > 0).sum() < _LEAST_MATCHES:
        return None
    t = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    stated = np.cross(t, relative[:3, :3].T).T
    return _sampson(stated, one[kept], other[kept]) / pixel, _sampson(fitted, one[kept], other[kept]) / pixel


def _matched(first: _Features, second: _Features) -> tuple[Array, Array]:
    """Rays [M, 2] of what both photographs show: each other's best match, better by far than the second best."""
    if min(len(first.rays), len(second.rays)) < _LEAST_MATCHES:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {match.queryIdx: match.trainIdx for match in matcher.match(second.descriptors, first.descriptors)}
    pairs: Any = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    good = [
        best
        for best, next_best in pairs
        if best.distance < _RATIO * next_best.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    return first.rays[[match.queryIdx for match in good]], second.rays[[match.trainIdx for match in good]]


def _sampson(essential: Array, one: Array, other: Array) -> float:
    """Median Sampson distance of matches [M, 2] from an essential matrix, on the plane z = 1."""
    here, there = (np.column_stack([rays, np.ones(len(rays))]) for rays in (one, other))
    lines_there, lines_here = here @ essential.T, there @ essential
    slopes = (lines_there[:, :2] ** 2).sum(1) + (lines_here[:, :2] ** 2).sum(1)
    return float(np.median(np.abs((there * lines_there).sum(1)) / np.sqrt(slopes + 1e-30)))
