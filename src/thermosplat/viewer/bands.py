"""Large pictures are rendered in bands of rows: each takes little memory, and between two the work may be stopped."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.viewer.layers import Layer, LayerImage

BAND_PIXELS = {"cpu": 1 << 19}
"""Of a band, by the kind of device. On a CPU of two cores it takes about a second."""
BAND_PIXELS_ELSEWHERE = 1 << 23
"""On a GPU: all of a window of 3840 x 2160, whose Gaussians are projected once."""
_TILE = 16
"""Rows of the rasterizer's tiles: bands begin where the whole picture's tiles do."""


def bands(view: ViewTensors) -> Iterator[ViewTensors]:
    """The parts of a picture, from top to bottom, as cameras of their own.

    Args:
        view: The whole picture's camera, without an image.
    """
    pixels = BAND_PIXELS.get(view.K.device.type, BAND_PIXELS_ELSEWHERE)
    rows = max(1, pixels // (view.width * _TILE)) * _TILE
    for top in range(0, view.height, rows):
        K = view.K.clone()
        K[1, 2] -= top
        yield replace(view, K=K, height=min(rows, view.height - top))


def joined(parts: Sequence[dict[Layer, LayerImage]]) -> dict[Layer, LayerImage]:
    """The layers of a whole picture.

    Args:
        parts: Those of its bands, from top to bottom; at least one.
    """
    if len(parts) == 1:
        return parts[0]
    return {
        layer: replace(
            image,
            field=None if image.field is None else np.concatenate([part[layer].field for part in parts]),
            colors=None if image.colors is None else np.concatenate([part[layer].colors for part in parts]),
        )
        for layer, image in parts[0].items()
    }
