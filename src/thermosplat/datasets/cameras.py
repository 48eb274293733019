"""Cameras: intrinsics with an image size, and the lens where images are as they were taken.

Conventions: pixel centres lie at half-integers (the first pixel's centre is (0.5, 0.5)), as in COLMAP and gsplat;
camera axes are OpenCV's (x right, y down, z forward); poses are world-to-camera ``viewmat`` [4, 4].
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FARTHEST_CAMERA = 1e12
"""Largest distance of a camera from the origin [world units]: in float32, squares of larger ones soon overflow."""
_FAR = 1e3
"""Distance [world units] beyond which a rotation that a file has rounded is not inverted by its transpose: with six
digits the error would be a thousandth of a unit."""


class LensCoefficients(NamedTuple):
    """How a lens bends its image; coefficients of OpenCV's models, which do not depend on the image's size."""

    model: str
    """The rasterizer's ``camera_model``."""
    radial: tuple[float, float, float, float, float, float]
    """k1 to k6; of a fisheye lens k1 to k4 and zeros."""
    tangential: tuple[float, float]
    """p1 and p2; zeros of a fisheye lens."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics and the size of the image they belong to; a pinhole's without a lens."""

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
    lens: LensCoefficients | None = None
    """Of images that are as they were taken (``--lens direct``); None: a pinhole."""

    @property
    def lens_model(self) -> str:
        """The rasterizer's ``camera_model``: the lens's, or a pinhole."""
        return "pinhole" if self.lens is None else self.lens.model

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
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )


def camera_center(viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position of a camera in the world, shape [3].

    Args:
        viewmat: [4, 4] world to camera, a rigid motion.
    """
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    if not np.abs(center).max() > _FAR:
        return center
    return np.asarray(np.linalg.solve(viewmat[:3, :3], -viewmat[:3, 3]), np.float64)
