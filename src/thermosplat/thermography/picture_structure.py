"""What pictures show beside noise: how noisy one is, what is small in it, and how far apart several are."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors

Array = NDArray[np.float64]


def scatter_of(images: Sequence[Tensor]) -> Array:
    """How far apart images are, by the median, mean over their channels, [H, W]; 0 where they show nothing."""
    of_each = torch.stack(list(images))
    apart = (of_each - of_each.nanmedian(dim=0).values).abs().nanmedian(dim=0).values
    return 1.4826 * apart.mean(dim=-1).nan_to_num().double().cpu().numpy()  # standard deviations, were they normal


def opened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Without what is narrower than 5 pixels: at edges depths and normals are those of neither side."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0


def stands_out(values: Array, noise: float, depth: Tensor, view: ViewTensors, focal: float) -> NDArray[np.bool_]:
    """Where a value stands out of what 3x3 pixels of the sensor fit into, by more than its noise explains.

    Args:
        values: The picture, [H, W].
        noise: Standard deviation of the sensor's noise.
        depth: How deep the picture is, [H, W].
        view: Its camera.
        focal: Focal length of the sensor [px].
    """
    seen = depth[depth > 0]
    away = float(seen.median()) if view.orthographic and len(seen) else 1.0
    square = np.ones((max(3, round(3 * away * float(view.K[0, 0]) / focal)),) * 2, np.uint8)
    filled = np.nan_to_num(values, nan=float(np.nanmedian(values))).astype(np.float32)
    warm, cold = (cv2.morphologyEx(filled, how, square) for how in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT))
    return np.maximum(warm, cold) > max(5 * noise, 0.02 * float(np.ptp(filled)))


def noise_of(values: Array) -> float:
    """Standard deviation of white noise in an image (Immerkaer 1996), of the half of the image with less structure."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float64)
    response = np.abs(cv2.filter2D(np.nan_to_num(values, nan=float(np.nanmedian(values))), cv2.CV_64F, kernel))
    return float(np.median(response[1:-1, 1:-1]) / 0.6745 / 6)
