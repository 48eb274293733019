"""Whether thermal images are mirrored or turned against the photographs, or against their own registered camera.

Edges of both images are correlated in all eight orientations, at several sizes and with any shift, summed over pairs.
The same of pairs that do not belong together is subtracted, so that what all images have in common does not count. On
arco's files this gives 0.07 for the true orientation and at most 0.02 for the others; scenes with large parallax give
nothing that stands out, and then nothing is said.

Where the thermal camera is registered, edges are compared where it sees them, at the depth of the scene's middle: 0.10
on rig_desk and 0.50 on a real room for images that are as they were registered, 0.01 and 0.09 at most for others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.checking.plane_warp import PlaneWarp

_HEIGHT = 96
"""Of the reduced photographs [px]."""
_REGISTERED_WIDTH = 160
"""Of photographs beside thermal images of a registered camera [px]."""
_SIZES = (1.0, 0.85, 0.72, 0.61)
"""Sizes of the thermal field of view relative to the photograph's that are tried."""
_CONTROLS = (3, 5, 7)
"""Distances of the wrong partners in the list."""
_LEAST_PAIRS = 8
_LEAST_SCORE, _LEAST_RATIO = 0.05, 2.0
"""From which score on, and how far above the next orientation, the best one is believed; see above."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Of an RGB colour, ITU-R BT.601."""


@dataclass(frozen=True)
class Orientation:
    """How thermal images have to be turned to look like the photographs: first clockwise, then mirrored."""

    turn: int
    mirror: bool

    @property
    def upright(self) -> bool:
        """Nothing has to be turned."""
        return self.turn == 0 and not self.mirror

    @property
    def flags(self) -> str:
        """The flags of ``thermosplat-prepare import`` that do it."""
        return " ".join([*([f"--turn {self.turn}"] if self.turn else []), *(["--mirror"] if self.mirror else [])])


def find_orientation(pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Orientation | None:
    """The orientation of thermal images, where it stands out; None where it does not.

    Args:
        pairs: Photographs [H, W, 3] and thermal images [H, W] or [H, W, 3], at least 8 of them.
    """
    if len(pairs) < _LEAST_PAIRS:
        return None
    height, width = pairs[0][0].shape[:2]
    size = round(_HEIGHT * width / height), _HEIGHT
    photographs = [edge_strength(photograph, *size) for photograph, _ in pairs]
    scores = {
        Orientation(90 * quarter, mirror): max(
            _score(photographs, [_window(_oriented(thermal, quarter, mirror), size, part) for _, thermal in pairs])
            for part in _SIZES
        )
        for quarter in range(4)
        for mirror in (False, True)
    }
    return _outstanding(scores)


def orientation_as_registered(
    pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]], warps: Sequence[PlaneWarp]
) -> Orientation | None:
    """How thermal images have to be turned to be what their registered camera sees; None where nothing stands out.

    Args:
        pairs: Photographs [H, W, 3] and thermal images [H, W] or [H, W, 3], at least 8 of them.
    """
    if len(pairs) < _LEAST_PAIRS:
        return None
    height, width = pairs[0][0].shape[:2]
    size = _REGISTERED_WIDTH, round(_REGISTERED_WIDTH * height / width)
    photographs = [edge_strength(photograph, *size) for photograph, _ in pairs]
    lens = warps[0].thermal
    scores = {}
    for quarter in range(4):
        for mirror in (False, True):
            turned = [_oriented(thermal, quarter, mirror) for _, thermal in pairs]
            high, wide = turned[0].shape[:2]
            if high * lens.width == wide * lens.height:  # others are no images of this camera
                seen = [_seen(image, warp, size) for image, warp in zip(turned, warps)]
                scores[Orientation(90 * quarter, mirror)] = _agreement(photographs, seen)
    return _outstanding(scores)


def _outstanding(scores: dict[Orientation, float]) -> Orientation | None:
    if len(scores) < 2:
        return None
    (best, score), (_, second) = sorted(scores.items(), key=lambda item: -item[1])[:2]
    return best if score >= _LEAST_SCORE and score >= _LEAST_RATIO * second else None


def _seen(image: NDArray[Any], warp: PlaneWarp, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Edges of a thermal image as the photograph's camera sees them; 0 where the thermal camera does not look."""
    edges = edge_strength(image, _REGISTERED_WIDTH, round(_REGISTERED_WIDTH * image.shape[0] / image.shape[1]))
    levels = np.clip(1 + 80 * (edges - edges.min()), 1, 255).astype(np.uint8)
    return warp.thermal_on_photograph(np.repeat(levels[..., None], 3, -1), *size)[..., 0]


def _agreement(photographs: Sequence[NDArray[np.float32]], seen: Sequence[NDArray[np.uint8]]) -> float:
    """Mean correlation of the pairs where both see, above that of wrong pairs."""

    def mean(distance: int) -> float:
        found = []
        for place, photograph in enumerate(photographs):
            thermal = seen[(place + distance) % len(seen)]
            both = cv2.erode((thermal > 0).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            if both.sum() > 2 * _HEIGHT:
                found.append(np.corrcoef(photograph[both], thermal[both])[0, 1])
        return float(np.nan_to_num(found).mean()) if found else 0.0

    return mean(0) - float(np.mean([mean(distance) for distance in _CONTROLS]))


def _score(photographs: Sequence[NDArray[np.float32]], windows: Sequence[NDArray[np.float32]]) -> float:
    """Best correlation of the pairs over all shifts, above that of wrong pairs."""
    return _correlation(photographs, windows, 0) - float(
        np.mean([_correlation(photographs, windows, distance) for distance in _CONTROLS])
    )


def _correlation(
    photographs: Sequence[NDArray[np.float32]], windows: Sequence[NDArray[np.float32]], distance: int
) -> float:
    count = len(windows)
    maps = [
        cv2.matchTemplate(photograph, windows[(place + distance) % count], cv2.TM_CCOEFF_NORMED)
        for place, photograph in enumerate(photographs)
    ]
    return float(np.mean(maps, axis=0).max())


def _oriented(image: NDArray[Any], quarter: int, mirror: bool) -> NDArray[Any]:
    turned = np.rot90(image, -quarter)
    return turned[:, ::-1] if mirror else turned


def _window(image: NDArray[Any], size: tuple[int, int], part: float) -> NDArray[np.float32]:
    """Edges of a thermal image that fills a part of the photograph, without the rim, so that it can be shifted."""
    aspect = image.shape[1] / image.shape[0]
    height = min(size[1] * part, size[0] * part / aspect)
    edges = edge_strength(image, max(16, round(height * aspect)), max(16, round(height)))
    rim = int(0.06 * edges.shape[0]) + 2
    return np.ascontiguousarray(edges[rim:-rim, rim:-rim])


def edge_strength(image: NDArray[Any], width: int, height: int) -> NDArray[np.float32]:
    """Strength of the edges [height, width], equalised over the image."""
    grey = image.astype(np.float32)
    if grey.ndim == 3:
        grey = grey @ LUMA
    grey = cv2.GaussianBlur(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), (0, 0), 1)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    local = cv2.GaussianBlur(strength, (0, 0), 8) + 0.05 * strength.mean() + 1e-6
    equalised = np.minimum(strength / local, 3)
    return np.asarray(equalised - equalised.mean(), np.float32)
