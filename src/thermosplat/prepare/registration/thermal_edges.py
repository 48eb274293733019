"""Edges of thermal images, whatever their unit: slopes measured against the noise and the contrast around them."""

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]

_SMOOTHING, _NEIGHBOURHOOD = 0.8, 8.0
"""Standard deviations [px] of the blur against noise, and of the neighbourhood whose contrast becomes one."""
_NOISE_FLOOR = 3.0
"""Contrasts below this many standard deviations of the noise are not raised to one."""
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_MAD = 0.6745
"""Median absolute value of a normal distribution with standard deviation 1."""


def mirrored(field: Field) -> Field:
    """The slopes of the mirrored image, left and right."""
    return np.ascontiguousarray(field[:, ::-1] * np.array([-1, 1], np.float32))


def slopes(image: NDArray[np.generic]) -> Field:
    """Slopes [H, W, 2] of the locally normalised image [contrasts per pixel].

    Args:
        image: [H, W] values in any unit.
    """
    return slopes_of(normalised(image))


def slopes_of(normal: Field) -> Field:
    """Slopes [H, W, 2] of an image [H, W] that is locally normalised."""
    return np.stack([cv2.Sobel(normal, cv2.CV_32F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1))], -1)


def normalised(image: NDArray[np.generic]) -> Field:
    """The image [H, W] less the mean around each pixel, over the contrast there.

    Args:
        image: [H, W] values in any unit.
    """
    values = image.astype(np.float32)
    # Immerkaer, Fast Noise Variance Estimation (1996): this mask answers with 6 standard deviations of white noise
    noise = float(np.median(np.abs(cv2.filter2D(values, -1, _LAPLACIAN)))) / _MAD / 6
    smooth = cv2.GaussianBlur(values, (0, 0), _SMOOTHING)
    deviation = smooth - cv2.GaussianBlur(smooth, (0, 0), _NEIGHBOURHOOD)
    contrast = np.sqrt(cv2.GaussianBlur(deviation**2, (0, 0), _NEIGHBOURHOOD))
    return deviation / (contrast + _NOISE_FLOOR * noise + 1e-6 * float(np.abs(values).max()) + 1e-12)
