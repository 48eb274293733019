"""Camera paths through a capture: sequences of world-to-camera matrices made from its training poses.

Convention: viewmats [F, 4, 4] are world-to-camera with OpenCV axes (x right, y down, z forward); "up" is -y.
"""

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError

Matrices = NDArray[np.floating]

SPIRAL_TURNS = 2  # as in LLFF's spiral, which this path follows in spirit


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
    """An ellipse around what the cameras look at, in the plane they were moved in; for captures that go round a scene.

    Args:
        viewmats: Training poses, shape [V, 4, 4], V >= 3.
        num_frames: Poses of the path F.

    Returns:
        Shape [F, 4, 4]; every pose looks at the point nearest to all optical axes.
    """
    _require(viewmats, 3, "ellipse")
    poses = np.linalg.inv(viewmats)
    centres, up = poses[:, :3, 3], _unit(-poses[:, :3, 1].mean(axis=0))
    focus = focus_point(poses)
    offsets = centres - focus
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    major = np.linalg.svd(level - level.mean(axis=0))[2][0]
    major = _unit(major - (major @ up) * up)
    minor = np.cross(up, major)
    # 90th percentile: the ellipse stays among the cameras and off their outliers.
    radius_major, radius_minor = (np.percentile(np.abs(level @ axis), 90) for axis in (major, minor))
    angles = np.linspace(0, 2 * np.pi, num_frames, endpoint=False)[:, None]
    path = focus + radius_major * np.cos(angles) * major + radius_minor * np.sin(angles) * minor + heights.mean() * up
    return np.stack([look_to(centre, focus - centre, up) for centre in path])


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
    focus, reach = focus_point(poses), np.linalg.norm(radii)
    focus_depth = np.median(np.einsum("vi,vi->v", focus - centres, poses[:, :3, 2]))
    # Parallel cameras have no focus; what they look at then lies ahead of all of the spiral, within 45 degrees.
    target = focus if focus_depth > 0.5 * reach else centre + 2 * reach * forward
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
