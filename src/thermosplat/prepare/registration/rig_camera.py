"""A camera on the same mount as the photographs' camera: its pose there, its lens, and derivatives of where it sees.

The lens is COLMAP's RADIAL model: with u = (x/z, y/z) and r² = |u|², a point is seen at

    f (1 + k1 r² + k2 r⁴) u + (cx, cy)     [px, pixel centres at half-integers]

Derivatives are in the order of ``UNKNOWNS``. Rotations are perturbed from the left: R ← exp([w]×) R.
"""

from dataclasses import dataclass, replace

import cv2  # before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

UNKNOWNS = ("rx", "ry", "rz", "tx", "ty", "tz", "log_f", "cx", "cy", "k1", "k2")
"""Rotation [rad], translation [world units], logarithm of the focal length, principal point [px], radial terms."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigCamera:
    """Where a camera is on the mount, and its lens.

    Args:
        rotation: [3, 3] from the photographs' camera to this one.
        translation: [3] of the same transform [world units].
        lens: [5] focal length, cx, cy [px], k1, k2.
        width: Image width [px].
        height: Image height [px].
    """

    rotation: Array
    translation: Array
    lens: Array
    width: int
    height: int

    @classmethod
    def looking_along(cls, width: int, height: int, focal_length: float, rotation: Array | None = None) -> "RigCamera":
        """A camera at the place of the photographs' camera, without distortion.

        Args:
            width: Image width [px].
            height: Image height [px].
            focal_length: [px].
            rotation: [3, 3]; None: the same direction.
        """
        lens = np.array([focal_length, width / 2, height / 2, 0.0, 0.0])
        return cls(np.eye(3) if rotation is None else rotation, np.zeros(3), lens, width, height)

    def colmap_camera(self) -> pycolmap.Camera:
        """The lens as a pycolmap camera."""
        return pycolmap.Camera(model="RADIAL", params=self.lens.tolist(), width=self.width, height=self.height)

    def colmap_pose(self) -> pycolmap.Rigid3d:
        """The pose as COLMAP's ``sensor_from_rig``, the photographs' camera being the reference."""
        return pycolmap.Rigid3d(np.column_stack([self.rotation, self.translation]))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Projects points to the image.

        Args:
            points: [N, 3] in the axes of the photographs' camera.

        Returns:
            Pixels [N, 2] and depths [N]; pixels mean nothing where the depth is not positive.
        """
        local = points @ self.rotation.T + self.translation
        depth = local[:, 2]
        u = local[:, :2] / np.where(np.abs(depth) < 1e-9, 1e-9, depth)[:, None]
        f, cx, cy, k1, k2 = self.lens
        r2 = (u**2).sum(1, keepdims=True)
        return f * u * (1 + k1 * r2 + k2 * r2**2) + [cx, cy], depth

    def derivatives(self, points: Array) -> Array:
        """Derivatives [N, 2, 11] of the pixels by ``UNKNOWNS``.

        Args:
            points: [N, 3] in the axes of the photographs' camera, in front of this one.
        """
        f, _, _, k1, k2 = self.lens
        turned = points @ self.rotation.T
        local = turned + self.translation
        z = local[:, 2]
        u = local[:, :2] / z[:, None]
        r2 = (u**2).sum(1)
        stretch = 1 + k1 * r2 + k2 * r2**2
        by_u = f * (stretch[:, None, None] * np.eye(2) + 2 * (k1 + 2 * k2 * r2)[:, None, None] * _outer(u, u))
        by_local = by_u @ np.concatenate([np.eye(2) / z[:, None, None], -(u / z[:, None])[:, :, None]], axis=2)
        result = np.zeros((len(points), 2, len(UNKNOWNS)))
        result[:, :, :3] = -by_local @ cross_matrices(turned)
        result[:, :, 3:6] = by_local
        result[:, :, 6] = f * u * stretch[:, None]
        result[:, 0, 7] = result[:, 1, 8] = 1
        result[:, :, 9] = f * u * r2[:, None]
        result[:, :, 10] = f * u * (r2**2)[:, None]
        return result

    def moved(self, step: Array) -> "RigCamera":
        """This camera after a step [11] in the order of ``UNKNOWNS``."""
        lens = self.lens + np.concatenate([[0.0], step[7:]])
        lens[0] *= np.exp(step[6])
        rotation = cv2.Rodrigues(np.ascontiguousarray(step[:3]))[0] @ self.rotation
        return replace(self, rotation=rotation, translation=self.translation + step[3:6], lens=lens)


def _outer(a: Array, b: Array) -> Array:
    return a[:, :, None] * b[:, None, :]


def cross_matrices(v: Array) -> Array:
    """[N, 3, 3] matrices that take the cross product with v [N, 3] from the left."""
    result = np.zeros((len(v), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return result - result.transpose(0, 2, 1)
