"""Depths by a plane sweep: for each pixel of a view, the depth at which the images of its neighbours agree.

Collins 1996, "A space-sweep approach to true multi-image matching". The view's own image is not used. What it finds is
what images say of depth where no scene is trained: neither smoothness nor a model of surfaces takes part.
"""

import warnings
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenes.surface_points import surface_points
from thermosplat.datasets.capture import View
from thermosplat.datasets.frame_tensors import unit_image

Array = NDArray[np.float64]
HYPOTHESES = 160
"""Depths that are tried, evenly in their inverse, as disparities are."""
NEIGHBOURS = 10
ALONG = 0.8
"""Least cosine of the angle between the axes of two neighbours."""
WORST = 0.1
"""Most that an image counts for [of its range], so that what is hidden in one does not decide."""
ROWS = 32_000
"""Places that cv2 looks up at once; it takes images of up to 32,767."""
FEWEST = 3
"""Images that must show a place."""


def in_unit_range(view: View) -> NDArray[np.float32]:
    """A view's image in [0, 1], [H, W, C]."""
    image: NDArray[np.float32] = unit_image(torch.from_numpy(view.pixels().image)).numpy()
    return image


def carried(places: Array, view: View, image: NDArray[np.float32]) -> Array:
    """What a view shows at places of the scene.

    Args:
        places: Shape [P, 3] [world units].
        view: The view, without lens distortion.
        image: Its image, [H, W, C].

    Returns:
        Shape [P, C]; NaN outside the image.
    """
    camera = view.camera
    seen = places @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    at = (seen @ camera.K.T)[:, :2] / seen[:, 2:].clip(1e-9) - 0.5  # cv2 counts from the centre of the first pixel
    inside = (seen[:, 2] > 0) & (at >= 0).all(1) & (at <= (camera.width - 1, camera.height - 1)).all(1)
    at = np.where(inside[:, None], at, 0.0).astype(np.float32).reshape(-1, 1, 2)
    shown = np.zeros((len(places), image.shape[-1]), np.float32)
    for i in range(0, len(places), ROWS):
        part = cv2.remap(image, at[i : i + ROWS], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        shown[i : i + ROWS] = part.reshape(-1, image.shape[-1])
    return np.where(inside[:, None], shown, np.nan)


def neighbours(view: View, others: Sequence[View]) -> list[View]:
    """The nearest of other views that look about the same way."""

    def centre(one: View) -> Array:
        return np.linalg.inv(one.viewmat)[:3, 3]

    along = [one for one in others if one.viewmat[2, :3] @ view.viewmat[2, :3] > ALONG]
    return sorted(along, key=lambda one: float(np.linalg.norm(centre(one) - centre(view))))[:NEIGHBOURS]


def swept_depths(
    view: View, others: Sequence[View], nearest: float, farthest: float, windows: Sequence[int]
) -> dict[int, Array]:
    """Depths [world units] of a view, [H, W], by the side of the window over which errors are averaged [px].

    Args:
        view: The view.
        others: Views of the same spectrum, of which the neighbours are used.
        nearest: Smallest depth that is tried [world units].
        farthest: Largest one.
        windows: Sides [px].
    """
    images = [(one, in_unit_range(one)) for one in neighbours(view, others)]
    shape = view.camera.height, view.camera.width
    depths = 1.0 / np.linspace(1.0 / nearest, 1.0 / farthest, HYPOTHESES)
    best = {window: np.full(shape, np.inf) for window in windows}
    found = {window: np.full(shape, farthest) for window in windows}
    for depth in depths:
        places = surface_points(view, np.full(shape, depth)).reshape(-1, 3)
        shown = np.stack([carried(places, *one) for one in images])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of places that no image shows
            errors = np.abs(shown - np.nanmedian(shown, axis=0)).mean(-1).clip(max=WORST)
            error = np.nanmean(errors, axis=0)
        error[(~np.isnan(errors)).sum(0) < FEWEST] = WORST
        for window in windows:
            smooth = cv2.blur(error.reshape(shape), (window, window))
            better = smooth < best[window]
            best[window][better], found[window][better] = smooth[better], depth
    return found
