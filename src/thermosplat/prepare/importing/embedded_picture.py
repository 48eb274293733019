"""Whether the values of a radiometric file and the picture in it show the same.

Edges of both are compared at a small size: those of the values' ranks, so that no unit and no contrast counts, and
those of the picture's colours, so that no palette does. A shift of some pixels is allowed: pictures of a DJI H20N lie
12 px beside their values. In eleven files of DJI's cameras the correlation is 0.75 to 0.97. For values that are
mirrored or turned by 180° it is 0.18 at most, between files 0.14 (``benchmarks/records/prepare.md``).
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDTH = 160
"""At which they are compared [px]."""
_SHIFT = 6
"""Largest shift at that width [px]."""
_LEAST = 0.3
"""Correlation from which on they show the same; see above."""


def shows_the_same(values: NDArray[Any], picture: NDArray[np.uint8], zoom: float = 1.0) -> bool:
    """Whether a picture shows what values measure.

    Args:
        values: [H, W] in any unit; NaN where there is none.
        picture: [h, w] or [h, w, 3] in any palette, perhaps turned by 90° as a whole.
        zoom: The picture may show the middle of the values alone, enlarged so many times.
    """
    picture = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, -1)
    finite = np.isfinite(values)
    whole = np.where(finite, values, np.median(values[finite]) if finite.any() else 0)
    turned = (picture.shape[0] > picture.shape[1]) != (values.shape[0] > values.shape[1])
    pictures = [np.rot90(picture, quarter) for quarter in (1, 3)] if turned else [picture]
    parts = [whole] if zoom <= 1 else [whole, _middle(whole, zoom)]
    return any(_correlation(part, np.ascontiguousarray(one)) >= _LEAST for part in parts for one in pictures)


def _middle(values: NDArray[Any], zoom: float) -> NDArray[Any]:
    height, width = (max(1, round(side / zoom)) for side in values.shape)
    top, left = (values.shape[0] - height) // 2, (values.shape[1] - width) // 2
    return values[top : top + height, left : left + width]


def _correlation(values: NDArray[Any], picture: NDArray[np.uint8]) -> float:
    """The best one of their edges over small shifts."""
    size = _WIDTH, max(2 * _SHIFT + 4, round(_WIDTH * values.shape[0] / values.shape[1]))
    small = cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    ranks = np.argsort(np.argsort(small.ravel(), kind="stable"), kind="stable").reshape(small.shape)
    edges = _edges(ranks[..., None].astype(np.float32))
    seen = _edges(cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32))
    inner = np.ascontiguousarray(edges[_SHIFT:-_SHIFT, _SHIFT:-_SHIFT])
    return float(np.nan_to_num(cv2.matchTemplate(seen, inner, cv2.TM_CCOEFF_NORMED)).max())


def _edges(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Strength of the edges of all channels [H, W], equalised over the image."""
    smooth = [cv2.GaussianBlur(np.ascontiguousarray(channel), (0, 0), 1) for channel in np.moveaxis(image, -1, 0)]
    slopes = [cv2.Sobel(channel, cv2.CV_32F, *order) for channel in smooth for order in ((1, 0), (0, 1))]
    strength = np.sqrt(np.sum(np.square(slopes), axis=0))
    local = cv2.GaussianBlur(strength, (0, 0), 8) + 0.05 * strength.mean() + 1e-6
    return np.minimum(strength / local, 3).astype(np.float32)
