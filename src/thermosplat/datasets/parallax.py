"""How far apart the directions are from which cameras see a place: what says how well its depth can be known."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LEAST_ANGLE = 5.0
"""Median triangulation angle [°] below which a capture was taken by turning rather than moving. Open choice: the room
that was taken on the spot has 2.7, captures taken in walking 17 to 141 (benchmarks/records/real-captures.md)."""
_MOST_POINTS = 2000
"""Points that are looked at, evenly chosen."""


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


def triangulation_angle(cameras: Sequence[Seen], points: NDArray[np.floating]) -> float | None:
    """Median over points of the largest angle between the rays of two cameras in whose images they lie [°].

    Which cameras found a point is not asked for, so that what hides it does not count.

    Args:
        cameras: The cameras.
        points: Places of the scene, [P, 3] [world units].

    Returns:
        The angle; None where no two cameras see a point.
    """
    places = points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)
    rays, inside = [], []
    for one in cameras:
        viewmat = np.asarray(one.viewmat, np.float64)
        in_camera = places @ viewmat[:3, :3].T + viewmat[:3, 3]
        at = in_camera @ np.asarray(one.K, np.float64).T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = at[:, :2] / at[:, 2:]
            inside.append((in_camera[:, 2] > 0) & ((at >= 0) & (at < (one.width, one.height))).all(1))
            rays.append(in_camera @ viewmat[:3, :3] / np.linalg.norm(in_camera, axis=1, keepdims=True))
    angles = []
    for seen, of_point in zip(np.array(inside).T, np.array(rays).swapaxes(0, 1), strict=True):
        if seen.sum() > 1:
            cosines = of_point[seen] @ of_point[seen].T
            angles.append(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))
    return float(np.median(angles)) if angles else None


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
