"""Camera paths through a capture: sequences of world-to-camera matrices made from its training poses.

Convention: viewmats [F, 4, 4] are world-to-camera with OpenCV axes (x right, y down, z forward); "up" is -y.
"""

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError

Matrices = NDArray[np.floating]

SPIRAL_TURNS = 2  # as in LLFF's spiral, which this path follows in spirit
LARGEST_GAP = np.pi / 4
"""Where no camera stood for more than this angle, and for three times the usual one, the ellipse does not go."""
LEAST_ARC = np.pi / 18
"""Cameras on a shorter arc did not go round anything."""
LEAST_WIDTH = 0.2
"""Nor did those that look at no common point from a place that is narrower than this share of its length."""
MOST_ALIKE = 0.99
"""Mean squared cosine between cameras' axes and their common direction, above which they are parallel: within 6°."""
OUTLIER = 5.0
"""Cameras so many times as far from the middle as half of them are left out."""
SMOOTHED = np.pi / 18
"""Standard deviation of the angle over which cameras nearby count, at least."""


def interpolated_path(viewmats: Matrices, num_frames: int) -> Matrices:
    """A smooth path through the given poses in their order, at constant speed along its length.

    Centres follow a Catmull-Rom spline; so do viewing and up directions, which are made orthonormal again.

    Args:
        viewmats: Poses to pass through, shape [V, 4, 4], V >= 2.
        num_frames: Poses of the path F.

    Returns:
        Shape [F, 4, 4]; the first and the last are the given ones.
    """
    _require(viewmats, 2, "interp")
    poses = np.linalg.inv(viewmats)
    keys = np.stack([poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1]], axis=1)  # centre, forward, up
    dense_times = np.linspace(0, len(keys) - 1, 32 * (len(keys) - 1) + 1)
    dense = _catmull_rom(keys, dense_times)
    steps = np.linalg.norm(np.diff(dense[:, 0], axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    if length[-1] == 0:  # a camera that only turns
        length = dense_times
    times = np.interp(np.linspace(0, length[-1], num_frames), length, dense_times)
    return np.stack([look_to(centre, forward, up) for centre, forward, up in _catmull_rom(keys, times)])


def ellipse_path(viewmats: Matrices, num_frames: int) -> Matrices:
    """Round what the cameras look at, where they were: all the way, or to and fro along the arc they stood on.

    Distance, height and uprightness are those of the cameras nearby, in the mean; so is the viewing direction of
    cameras that look at no common point, such as a drone's that look straight down. Those that stand in one line are
    followed there and back.

    Args:
        viewmats: Training poses, shape [V, 4, 4], V >= 3.
        num_frames: Poses of the path F.

    Returns:
        Shape [F, 4, 4].
    """
    _require(viewmats, 3, "ellipse")
    poses = np.linalg.inv(viewmats)
    away = np.linalg.norm(poses[:, :3, 3] - np.median(poses[:, :3, 3], axis=0), axis=1)
    reach = float(np.median(away))
    if reach > 0:
        poses = poses[away < OUTLIER * reach]
    centres, forward, ups = poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1]
    spread = centres - centres.mean(axis=0)
    _, sizes, axes = np.linalg.svd(spread)
    focus = _focus_ahead(poses, reach)
    middle, axis = centres.mean(axis=0), axes[2]  # across the plane they were moved in
    if focus is not None:
        middle, axis = focus, _unit(ups.mean(axis=0))
    major = _unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    minor = np.cross(axis, major)
    offsets = centres - middle
    heights, right, ahead = offsets @ axis, offsets @ major, offsets @ minor
    angles, radii = np.arctan2(ahead, right), np.hypot(right, ahead)
    first, span, gap = _covered_arc(angles)
    if span < LEAST_ARC or (focus is None and sizes[1] < LEAST_WIDTH * sizes[0]):
        given = np.linalg.inv(poses)
        return interpolated_path(np.concatenate([given, given[-2::-1]]), num_frames)
    turns = np.linspace(0, 2 * np.pi, num_frames, endpoint=False)
    path_angles = first + (turns if span == 2 * np.pi else span * (1 - np.cos(turns)) / 2)
    apart = np.abs((path_angles[:, None] - angles + np.pi) % (2 * np.pi) - np.pi)
    weights = np.exp(-0.5 * (apart**2 - apart.min(axis=1, keepdims=True) ** 2) / max(gap, SMOOTHED) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    radius = weights @ radii
    path = middle + (weights @ heights)[:, None] * axis
    path += (radius * np.cos(path_angles))[:, None] * major + (radius * np.sin(path_angles))[:, None] * minor
    directions = weights @ forward if focus is None else focus - path
    return np.stack([look_to(*pose) for pose in zip(path, directions, weights @ ups)])


def _covered_arc(angles: Matrices) -> tuple[float, float, float]:
    """The arc along which most cameras stand, without a gap between them.

    Args:
        angles: Of the cameras, shape [V], in radians.

    Returns:
        Where it begins, its length, 2π where they stand all around, and the usual gap between them.
    """
    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    usual = float(np.median(gaps))
    ends = np.flatnonzero(gaps > max(LARGEST_GAP, 3 * usual))  # last cameras before a gap
    if len(ends) == 0:
        return float(ordered[0]), 2 * np.pi, usual
    counts = np.diff(ends, prepend=ends[-1] - len(angles))
    last, count = ends[counts.argmax()], counts.max()
    begin = ordered[(last - count + 1) % len(angles)]
    return float(begin), float((ordered[last] - begin) % (2 * np.pi)), usual


def spiral_path(viewmats: Matrices, num_frames: int) -> Matrices:
    """A spiral about the mean pose that keeps looking at the scene; for captures taken from one side.

    Args:
        viewmats: Training poses, shape [V, 4, 4], V >= 2.
        num_frames: Poses of the path F.

    Returns:
        Shape [F, 4, 4].
    """
    _require(viewmats, 2, "spiral")
    poses = np.linalg.inv(viewmats)
    centres = poses[:, :3, 3]
    centre, forward, up = centres.mean(axis=0), _unit(poses[:, :3, 2].mean(axis=0)), -poses[:, :3, 1].mean(axis=0)
    mean_pose = np.linalg.inv(look_to(centre, forward, up))
    radii = np.percentile(np.abs((centres - centre) @ mean_pose[:3, :3]), 90, axis=0)  # right, down, forward
    reach = float(np.linalg.norm(radii))
    focus = _focus_ahead(poses, reach)
    # what cameras without a focus look at lies ahead of all of the spiral, within 45 degrees
    target = centre + 2 * reach * forward if focus is None else focus
    angles = np.linspace(0, 2 * np.pi * SPIRAL_TURNS, num_frames, endpoint=False)
    local = np.stack([np.cos(angles), -np.sin(angles), -np.sin(angles / SPIRAL_TURNS)], axis=1) * radii
    path = centre + local @ mean_pose[:3, :3].T
    return np.stack([look_to(position, target - position, up) for position in path])


def look_to(centre: Matrices, forward: Matrices, up: Matrices) -> Matrices:
    """The world-to-camera matrix of a camera at a centre.

    Args:
        centre: Camera centre [world units], shape [3].
        forward: Viewing direction of any length, shape [3]; where it is zero, one across ``up`` is taken.
        up: Direction that points upwards in the image, shape [3]; another one is taken where it is parallel to
            ``forward``.

    Returns:
        Shape [4, 4].
    """
    z = _unit(forward)
    if not z.any():  # halfway between opposite directions, or at the very point that is looked at
        z = _unit(np.cross(up, np.eye(3)[np.abs(up).argmin()]))
    x = np.cross(z, _unit(up))
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x = _unit(x)
    rotation = np.stack([x, np.cross(z, x), z])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ centre
    return viewmat


def focus_point(poses: Matrices) -> Matrices:
    """The point nearest to all optical axes in the least-squares sense.

    Args:
        poses: Camera-to-world matrices, shape [V, 4, 4].

    Returns:
        Shape [3]. For parallel axes, where every point along them is as near, the one nearest to the origin.
    """
    directions, centres = poses[:, :3, 2], poses[:, :3, 3]
    projections = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # onto the plane across each axis
    return np.linalg.lstsq(projections.sum(axis=0), (projections @ centres[:, :, None]).sum(axis=0), rcond=1e-6)[0][
        :, 0
    ]


def _focus_ahead(poses: Matrices, reach: float) -> Matrices | None:
    """The point that the cameras look at; None of cameras that look in parallel, apart or past each other.

    Args:
        poses: Camera-to-world matrices, shape [V, 4, 4].
        reach: How far the cameras are from their middle.
    """
    focus, forward = focus_point(poses), poses[:, :3, 2]
    depths = np.einsum("vi,vi->v", focus - poses[:, :3, 3], forward)
    alike = np.linalg.eigvalsh(forward.T @ forward)[-1] / len(forward)
    return focus if np.median(depths) > 0.5 * reach and alike < MOST_ALIKE else None


def _catmull_rom(keys: Matrices, times: Matrices) -> Matrices:
    """Uniform Catmull-Rom spline through keys [V, ...] at times in [0, V - 1]; its ends have the chord's tangent."""
    padded = np.concatenate([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1]])
    segment = np.clip(np.floor(times).astype(int), 0, len(keys) - 2)
    t = (times - segment).reshape(-1, *[1] * (keys.ndim - 1))
    p0, p1, p2, p3 = (padded[segment + i] for i in range(4))
    return 0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)


def _unit(vector: Matrices) -> Matrices:
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else vector


def _require(viewmats: Matrices, count: int, path: str) -> None:
    if len(viewmats) < count:
        raise UserError(
            f"A camera path of the kind {path} needs at least {count} training views, the capture has {len(viewmats)}.",
            "Use --path train.",
        )
