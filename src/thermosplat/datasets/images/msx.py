"""FLIR's MSX, which engraves visible edges into thermal images, and how it shows."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_THRESHOLD = 0.3
"""Size of the median edge correlation above which MSX is likely. Measured on 14 RGBT-Scenes pairs: true thermal images
lie between -0.07 and 0.13, MSX exports between -0.36 and -0.95 (FLIR engraves negatively)."""
_EDGE_SIGMA = 2.0
"""Scale of the edges compared [px]."""
_SAMPLED_FRAMES = 6
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def edge_correlation(rgb: NDArray[np.uint8], thermal: NDArray[np.uint8]) -> float:
    """Correlation of the fine detail of an RGB image with that of a thermal one, both [H, W, 3]; 0 if one is flat."""
    details = []
    for image in (rgb, thermal):
        luma = image.astype(np.float32) @ _LUMA
        details.append((luma - cv2.GaussianBlur(luma, (0, 0), _EDGE_SIGMA)).ravel())
    if min(float(detail.std()) for detail in details) < 1e-3:
        return 0.0
    return float(np.corrcoef(details[0], details[1])[0, 1])


def msx_notes(pairs: Sequence[tuple[NDArray[Any] | None, NDArray[np.uint8] | None]]) -> list[str]:
    """A warning where the thermal images of a capture carry visible edges, as notes (none or one).

    Args:
        pairs: RGB and displayable thermal image of each frame; only colour pairs of one size are looked at.
    """
    alike = [
        (rgb, thermal)
        for rgb, thermal in pairs
        if rgb is not None and thermal is not None and rgb.shape == thermal.shape and rgb.ndim == 3
    ]
    if not alike:
        return []
    step = max(1, len(alike) // _SAMPLED_FRAMES)
    correlation = float(np.median([edge_correlation(rgb, thermal) for rgb, thermal in alike[::step]]))
    if abs(correlation) < _THRESHOLD:
        return []
    return [
        f"Thermal images carry visible edges (correlation {correlation:.2f}): FLIR MSX is probably on. "
        "Export them with MSX off; otherwise the model learns visible texture as temperature."
    ]
