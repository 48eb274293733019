"""Pinhole cameras: intrinsics with an image size.

Conventions: pixel centres lie at half-integers (the first pixel's centre is (0.5, 0.5)), as in COLMAP and gsplat;
camera axes are OpenCV's (x right, y down, z forward); poses are world-to-camera ``viewmat`` [4, 4].
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FARTHEST_CAMERA = 1e12
"""Largest distance of a camera from the origin [world units]: in float32, squares of larger ones soon overflow."""


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics and the size of the image they belong to."""

    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    distortion: tuple[float, float] | None = None
    """k1 and k2 of COLMAP's RADIAL model, where refining found that undistorting left some; None: a pinhole."""

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix, shape [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for an image resampled to another size.

        Args:
            width: New image width [px].
            height: New image height [px].

        Returns:
            A camera whose rays through corresponding image positions are unchanged.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height, self.distortion)


def camera_center(viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of a camera in the world, shape [3].

    Args:
        viewmat: [4, 4] world to camera, a rigid motion.
    """
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
