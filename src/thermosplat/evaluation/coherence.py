"""Cross-modal coherence: whether the spectra of a scene show the same things at the same places.

Good images of each spectrum do not say so: each may have a geometry of its own (arXiv 2606.05491, which asks for such a
measure). Both spectra are rendered by one camera. Depths are compared as they are; contours of depths and of images by
the F-score of Canny's edges: the share of one's edges that have one of the other's within two pixels, and the reverse,
their harmonic mean. Warm and cold things have contours that photographs lack, so images' score stays below 1 in a
perfect scene. It is to be compared between runs of one capture.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import combinations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import without_pixels
from thermosplat.scene.model import SceneModel

_WITHIN = 2
"""Pixels that edges may be apart."""
_LOW, _HIGH = 40, 100
"""Canny's thresholds for an image whose 1st to 99th percentile spans 0 to 255."""


@dataclass(frozen=True)
class Coherence:
    """Of two spectra over the held-out views; NaN where there is nothing to compare."""

    depth_difference: float
    """Median difference of depths, as a share of the nearer one."""
    depth_edges: float
    """F-score of the edges of depths, 0 to 1."""
    image_edges: float
    """F-score of the edges of images, 0 to 1."""


@torch.no_grad()
def coherence(model: SceneModel, capture: Capture, *, sh_degree: int) -> dict[str, dict[str, float]]:
    """How coherent each two spectra are, by "first-second".

    Args:
        capture: Its capture, whose held-out views' cameras are used: those of the second spectrum, else of the first.
    """
    made = {}
    for pair in combinations(model.spectra, 2):
        taken = [frame.views.get(pair[1], frame.views.get(pair[0])) for frame in capture.test]
        views = [without_pixels(view, model.device).as_pinhole() for view in taken if view is not None]
        found = []
        for view in views:
            images = model.render(dict.fromkeys(pair, view), sh_degree=sh_degree).images
            shown = {name: images[name].clamp(0, 1).mean(dim=-1).cpu().numpy() for name in pair}
            depths = {name: model.render_depth(name, view).cpu().numpy() for name in pair}
            found.append(_compared(shown, depths, pair))
        if found:
            means = np.nanmean(np.array(found), axis=0) if np.isfinite(found).any() else np.full(3, np.nan)
            made["-".join(pair)] = asdict(Coherence(*map(float, means)))
    return made


def _compared(
    images: Mapping[str, NDArray[np.floating]], depths: Mapping[str, NDArray[np.floating]], pair: tuple[str, str]
) -> tuple[float, float, float]:
    one, other = (depths[name] for name in pair)
    both = (one > 0) & (other > 0)
    if not both.any():
        return np.nan, np.nan, np.nan
    apart = float(np.median(np.abs(one - other)[both] / np.minimum(one, other)[both]))
    logarithms = [np.where(both, np.log(np.maximum(depth, 1e-12)), np.nan) for depth in (one, other)]
    of_depths = edge_agreement(edges(logarithms[0]), edges(logarithms[1]))
    return apart, of_depths, edge_agreement(*(edges(images[name]) for name in pair))


def edges(image: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Canny's edges of an image [H, W] of any unit; NaN has none."""
    known = np.isfinite(image)
    if not known.any():
        return np.zeros(image.shape, bool)
    low, high = np.percentile(image[known], [1, 99])
    filled = np.where(known, image, np.median(image[known]))
    if high - low <= 1e-6 * max(abs(low), abs(high), 1e-12):
        return np.zeros(image.shape, bool)
    shown = (255 * np.clip((filled - low) / (high - low), 0, 1)).astype(np.uint8)
    found = cv2.Canny(cv2.GaussianBlur(shown, (0, 0), 1.0), _LOW, _HIGH) > 0
    return found & (cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)


def edge_agreement(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """F-score of two images of edges, 0 to 1; NaN where neither has any."""
    if not one.any() and not other.any():
        return float("nan")
    if not one.any() or not other.any():
        return 0.0
    around = np.ones((2 * _WITHIN + 1,) * 2, np.uint8)
    near_one, near_other = (cv2.dilate(found.astype(np.uint8), around) > 0 for found in (one, other))
    precision, recall = float(near_other[one].mean()), float(near_one[other].mean())
    return 2 * precision * recall / max(precision + recall, 1e-12)
