"""How far apart the directions are from which cameras see a place: what says how well its depth can be known."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Frame

LEAST_ANGLE = 5.0
"""Median triangulation angle [°] below which a capture was taken by turning rather than moving. Open choice: the room
that was taken on the spot has 2.7, captures taken in walking 17 to 141 (benchmarks/records/real-captures.md)."""
_MOST_POINTS, _MOST_CAMERAS = 2000, 64
"""Points, and of the spacing cameras, that are looked at, evenly chosen."""


class Seen(NamedTuple):
    """A camera and the size of its image."""

    viewmat: NDArray[np.floating]
    """World to camera, [4, 4]."""
    K: NDArray[np.floating]
    """Intrinsics [px], [3, 3]; a lens is not asked for, so that points at the border count or not."""
    width: int
    """Of the image [px]."""
    height: int
    """Of the image [px]."""


def seen_first(frames: Sequence["Frame"]) -> list[Seen]:
    """The camera of each frame's first spectrum."""
    views = (next(iter(frame.views.values())) for frame in frames)
    return [Seen(view.viewmat, view.camera.K, view.camera.width, view.camera.height) for view in views]


def triangulation_angle(cameras: Sequence[Seen], points: NDArray[np.floating]) -> float | None:
    """Median over points of the largest angle between the rays of two cameras in whose images they lie [°].

    Which cameras found a point is not asked for, so that what hides it does not count.

    Args:
        points: Places of the scene, [P, 3] [world units].

    Returns:
        The angle; None where no two cameras see a point.
    """
    if len(cameras) < 2:
        return None
    places = points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)
    rays, inside = [], []
    for one in cameras:
        in_camera, shown = _seen_by(one, places)
        inside.append(shown)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = np.linalg.norm(in_camera, axis=1, keepdims=True)
            rays.append(in_camera @ np.asarray(one.viewmat, np.float64)[:3, :3] / away)
    angles = []
    for seen, of_point in zip(np.array(inside).T, np.array(rays).swapaxes(0, 1), strict=True):
        if seen.sum() > 1:
            cosines = of_point[seen] @ of_point[seen].T
            angles.append(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))
    return float(np.median(angles)) if angles else None


def point_spacing(
    cameras: Sequence[Seen], points: NDArray[np.floating], distances: NDArray[np.floating]
) -> float | None:
    """How far apart neighbouring points lie in the images [of their width], the median over what all cameras see.

    Points that something hides count, too.

    Args:
        points: Places of the scene, [P, 3] [world units].
        distances: Of each point to its neighbours, [P] [world units].

    Returns:
        The spacing; None where no camera sees a point.
    """
    every = max(1, len(points) // _MOST_POINTS)
    places, apart = points[::every].astype(np.float64), distances[::every]
    found = []
    for one in cameras[:: max(1, len(cameras) // _MOST_CAMERAS)]:
        in_camera, shown = _seen_by(one, places)
        found.append(one.K[0, 0] * apart[shown] / in_camera[shown, 2] / one.width)
    spacings = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(spacings)) if len(spacings) else None


def _seen_by(one: Seen, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Places in a camera's axes, [P, 3], and which of them lie in its image, [P]."""
    viewmat = np.asarray(one.viewmat, np.float64)
    in_camera = places @ viewmat[:3, :3].T + viewmat[:3, 3]
    at = in_camera @ np.asarray(one.K, np.float64).T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = at[:, :2] / at[:, 2:]
        return in_camera, (in_camera[:, 2] > 0) & ((at >= 0) & (at < (one.width, one.height))).all(1)


def parallax_remark(angle: float | None) -> str | None:
    """What to tell the user of a capture whose depths can hardly be known; None where they can.

    Args:
        angle: The median triangulation angle [°].
    """
    if angle is None or angle >= LEAST_ANGLE:
        return None
    return (
        f"Median triangulation angle {angle:.1f}°: the cameras turned more than they moved, so that depths are hardly "
        "known. Views from where images were taken will be good, others not. Move between images, do not turn on the "
        "spot."
    )
