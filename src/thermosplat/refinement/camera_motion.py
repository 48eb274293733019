"""How a camera changes by a few numbers: the small rotation, the rigid motions, the lens; and what it then sees.

A motion is (r, t), shape [6]: R(r) is the rotation of the quaternion (1, r / 2), normalised; for small r it turns by
|r| about r, and it has no singularity. Lengths t are multiples of the scene's extent, so that numbers mean the same in
captures of any unit.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.scene.lens_slopes import bent


def moved_frame(
    views: Mapping[str, ViewTensors], motion: Tensor, center: Tensor, scene_extent: float
) -> dict[str, ViewTensors]:
    """All cameras of a frame, moved as one: a point x of theirs goes to R (x - center) + center + t.

    Args:
        motion: (r, t), shape [6].
        center: The point about which they turn [world units], shape [3].
        scene_extent: Radius of the scene [world units], the unit of t.
    """
    # the inverse, y -> Rᵀ (y - center - t) + center, goes before the world-to-camera matrix
    back = rotation_matrix(motion[:3]).T
    inverse = _assembled(back, center - back @ (center + scene_extent * motion[3:]))
    return {name: replace(view, viewmat=view.viewmat @ inverse) for name, view in views.items()}


def moved_camera(view: ViewTensors, motion: Tensor, scene_extent: float) -> ViewTensors:
    """A camera moved in its own axes: what it sees at x is now at R(r) x + t.

    Args:
        motion: (r, t), shape [6].
        scene_extent: Radius of the scene [world units], the unit of t.
    """
    return replace(view, viewmat=rigid_motion(motion, scene_extent) @ view.viewmat)


def with_focal_factor(view: ViewTensors, logarithm: Tensor) -> ViewTensors:
    """A camera with both focal lengths multiplied.

    Args:
        logarithm: Of the factor, scalar.
    """
    factor, one = logarithm.exp(), torch.ones_like(logarithm)
    factors = torch.stack([factor, one, one, one, factor, one, one, one, one]).reshape(3, 3)
    return replace(view, K=view.K * factors)


def rigid_motion(motion: Tensor, scene_extent: float) -> Tensor:
    """The matrix [4, 4] of x -> R(r) x + t.

    Args:
        motion: (r, t), shape [6].
        scene_extent: Radius of the scene [world units], the unit of t.
    """
    return _assembled(rotation_matrix(motion[:3]), scene_extent * motion[3:])


def rotation_matrix(r: Tensor) -> Tensor:
    """The rotation of the quaternion (1, r / 2), normalised; exactly the identity for zero.

    Args:
        r: Shape [3] [rad], as long as small.

    Returns:
        Shape [3, 3].
    """
    x, y, z = r / 2
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # of a unit quaternion (w, v): I + 2 (w [v]x + [v]x²); here both are divided by its length
    factor = 2.0 / (1.0 + x * x + y * y + z * z)
    return torch.eye(3, dtype=r.dtype, device=r.device) + factor * (cross + cross @ cross)


def seen_points(view: ViewTensors, points: Tensor) -> Tensor:
    """Where a camera sees points [px], shape [M, 2].

    Args:
        points: Points before it [world units], shape [M, 3].
    """
    camera = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    point = bent(camera[:, :2] / camera[:, 2:], view)
    if view.distortion is not None:
        squared = point.square().sum(dim=1, keepdim=True)
        point = point * (1.0 + view.distortion[0] * squared + view.distortion[1] * squared.square())
    return point * view.K.diagonal()[:2] + view.K[:2, 2]


def _assembled(rotation: Tensor, translation: Tensor) -> Tensor:
    # made on the device: a step that is captured can copy nothing there
    last = torch.nn.functional.pad(rotation.new_ones(1, 1), (3, 0))
    return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), last])
