"""Whether thermal images show what the photographs beside them show: edges that both have lie at the same places.

Edges of a thermal image are seen from its photograph's camera over a plane at the depth of the sparse points, and
correlated with the photograph's. The same of pairs that do not belong together is subtracted. Where images that are
mirrored, turned, of a neighbour or shifted agree clearly better than those that are there, the sentence says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.checking.posed_photographs import projected
from thermosplat.prepare.checking.sensor_orientation import edge_strength
from thermosplat.spectra import label

_COMPARED = 24
"""Pairs that are looked at."""
_LEAST_PAIRS = 8
_LONG_SIDE = 200
"""Of the photographs that are looked at [px]."""
_CONTROLS = (3, 5, 7)
"""Distances of the wrong partners in the list."""
_LEAST_SCORE, _LEAST_SHIFTED = 0.04, 0.065
"""Correlation from which on another reading, or a shift, is believed: wrong ones have up to 0.04, and 0.05 is the best
of all shifts. Open choice, as are the next two."""
_LEAST_RATIO, _LEAST_GAIN = 1.4, 0.02
"""How far above that of the images as they are it has to be: of neighbours 1.6 and more where they are the right ones,
1.0 where views hardly differ, and of a shift 1.1 for images that are right."""
_LEAST_SHIFT = 0.0125
"""Shift of the best agreement [of the longer side] below which it is none: 2.5 px of the reduced images."""
_MOST_SHIFT = 0.12
"""Largest shift that is looked for [of the longer side]."""

_MIRRORED: Mapping[str, tuple[slice, slice]] = {
    "mirrored": (slice(None), slice(None, None, -1)),
    "turned by 180°": (slice(None, None, -1), slice(None, None, -1)),
    "upside down": (slice(None, None, -1), slice(None)),
}
_FLAGS = {"mirrored": "--mirror", "turned by 180°": "--turn 180", "upside down": "--turn 180 --mirror"}

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Agreement:
    """How well edges of two spectra agree.

    Args:
        scores: Correlation by reading: "stated", those of ``_MIRRORED``, "-1" and "+1" (the neighbour's image).
        shift: Of the thermal images against the photographs where edges agree best [of the longer side].
        shifted: Correlation there.
    """

    scores: Mapping[str, float]
    shift: tuple[float, float]
    shifted: float


def together_notes(
    spectrum: str, pairs: Sequence[tuple[View, View]], points: NDArray[np.floating], *, posed: bool
) -> list[str]:
    """A sentence (none or one) on images that do not show what the photographs beside them show.

    Args:
        pairs: Photographs, and images of the spectrum, in the order of their names.
        points: Sparse points [M, 3] [world units].
        posed: Whether cameras and points are to be believed, without which shifts say nothing.
    """
    found = together(pairs, points)
    if found is None:
        return []
    stated, what = found.scores["stated"], f"{label(spectrum)} images"
    best = max(found.scores, key=lambda name: found.scores[name])
    score = found.scores[best]
    ahead = max(_LEAST_RATIO * stated, stated + _LEAST_GAIN)
    if best in _MIRRORED and score > max(_LEAST_SCORE, ahead):
        return [
            f"{what[0].upper()}{what[1:]} are {best} against the photographs: edges would agree to {score:.2f}, and do "
            f"to {stated:.2f}. Turn them back, or import them again: thermosplat-prepare import {_FLAGS[best]}."
        ]
    if best in ("-1", "+1") and score > max(_LEAST_SCORE, ahead):
        where = "before" if best == "-1" else "after"
        return [
            f"{what[0].upper()}{what[1:]} are shifted by one frame: edges of photographs agree with the image {where} "
            f"theirs ({score:.2f} against {stated:.2f}). Pair them again: thermosplat-prepare pair."
        ]
    if posed and max(map(abs, found.shift)) >= _LEAST_SHIFT and found.shifted > max(_LEAST_SHIFTED, ahead):
        right, down = found.shift
        return [
            f"{what[0].upper()}{what[1:]} lie beside the photographs: edges agree best ({found.shifted:.2f} against "
            f"{stated:.2f}) for images moved by {right:+.1%} of their longer side to the right and {down:+.1%} "
            "down from where they belong. Register them anew: thermosplat-prepare register."
        ]
    return []


def together(pairs: Sequence[tuple[View, View]], points: NDArray[np.floating]) -> Agreement | None:
    """How well edges agree, over at most 24 pairs; None for fewer than 8.

    Args:
        pairs: Photographs, and images of another spectrum, in the order of their names.
        points: Sparse points [M, 3] [world units].
    """
    if len(pairs) < _LEAST_PAIRS:
        return None
    places = evenly_chosen(range(len(pairs)), _COMPARED)
    camera = pairs[0][0].camera
    factor = min(1.0, _LONG_SIDE / max(camera.width, camera.height))
    size = round(camera.width * factor), round(camera.height * factor)
    photographs = [_edges(pairs[place][0], size) for place in places]
    warps = [_homography(pairs[place][0], pairs[place][1], points, size, factor) for place in places]
    own = {number: _edges(pairs[place][1], _reduced(pairs[place][1], factor)) for number, place in enumerate(places)}

    def surface(thermal: Mapping[int, Image]) -> Image:
        """Of thermal images' edges by the number of the photograph that they are held against."""
        seen = [_seen(image, warps[number], size) for number, image in thermal.items()]
        return _surface([photographs[number] for number in thermal], seen)

    stated = surface(own)
    middle = stated.shape[0] // 2
    scores = {"stated": float(stated[middle, middle])}
    for name, cut in _MIRRORED.items():
        turned = {number: np.ascontiguousarray(image[cut]) for number, image in own.items()}
        scores[name] = float(surface(turned)[middle, middle])
    for step in (-1, 1):
        near = {number: place + step for number, place in enumerate(places) if 0 <= place + step < len(pairs)}
        images = {number: _edges(pairs[place][1], _reduced(pairs[place][1], factor)) for number, place in near.items()}
        scores[f"{step:+d}"] = float(surface(images)[middle, middle])
    down, right = np.unravel_index(int(stated.argmax()), stated.shape)
    shift = float(right - middle) / max(size), float(down - middle) / max(size)
    return Agreement(scores, shift, float(stated.max()))


def _edges(view: View, size: tuple[int, int]) -> Image:
    """Edges of an image that is reduced first, which saves most of the time."""
    return edge_strength(np.squeeze(cv2.resize(view.pixels().image, size, interpolation=cv2.INTER_AREA)), *size)


def _seen(edges: Image, warp: NDArray[np.float64], size: tuple[int, int]) -> Image:
    """Edges of a thermal image as the photograph's camera sees them; not a number where the thermal one does not."""
    outside = (np.nan, 0, 0, 0)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(edges, warp, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return np.asarray(seen, np.float32)


def _reduced(view: View, factor: float) -> tuple[int, int]:
    """Size of the images of a view, reduced as photographs are [px]."""
    return max(16, round(view.camera.width * factor)), max(16, round(view.camera.height * factor))


def _surface(photographs: Sequence[Image], thermal: Sequence[Image]) -> Image:
    """Mean correlation of the pairs by shift, above that of wrong pairs: [2 m + 1, 2 m + 1], no shift in the middle."""
    height, width = photographs[0].shape
    most = round(_MOST_SHIFT * max(height, width))
    shape = [cv2.getOptimalDFTSize(side + 2 * most) for side in (height, width)]
    sees = [np.isfinite(image) for image in thermal]
    filled = [_centred(image, seen) for image, seen in zip(thermal, sees)]
    one = [np.conj(np.fft.rfft2(image, shape)) for image in photographs]
    two = [np.fft.rfft2(image, shape) for image in filled]
    norms = [float(np.sqrt((image**2).sum())) for image in filled]

    def mean(distance: int) -> Image:
        total = np.zeros_like(one[0])
        for place, spectrum in enumerate(one):
            partner = (place + distance) % len(one)
            norm = norms[partner] * float(np.sqrt((photographs[place][sees[partner]] ** 2).sum()))
            total += spectrum * two[partner] / (max(norm, 1e-9) * len(one))
        moved = np.roll(np.fft.irfft2(total, shape), (most, most), (0, 1))
        return np.asarray(moved[: 2 * most + 1, : 2 * most + 1], np.float32)

    return mean(0) - np.mean([mean(distance) for distance in _CONTROLS], axis=0, dtype=np.float32)


def _centred(image: Image, sees: NDArray[np.bool_]) -> Image:
    """Edges without their mean, and 0 where nothing is seen."""
    return np.where(sees, image - image[sees].mean() if sees.any() else 0, 0).astype(np.float32)


def _homography(
    lead: View, view: View, points: NDArray[np.floating], size: tuple[int, int], factor: float
) -> NDArray[np.float64]:
    """Pixels of the reduced thermal image from those of the reduced photograph, over a plane at the points' depth."""
    moved = view.viewmat @ np.linalg.inv(lead.viewmat)
    plane = moved[:3, :3].copy()
    if np.abs(moved[:3, 3]).max() > 0:
        some = points[:: max(1, len(points) // 2000)].astype(np.float64)
        depths = (some @ lead.viewmat[:3, :3].T + lead.viewmat[:3, 3])[:, 2]
        shares, inside = projected(lead, lead.viewmat, 1.0, some)
        if len(shares):
            plane[:, 2] += moved[:3, 3] / float(np.median(depths[inside]))
    one, two = lead.camera.resized(*size).K, view.camera.resized(*_reduced(view, factor)).K
    middle = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV has pixel centres at whole numbers
    return np.asarray(np.linalg.inv(middle) @ two @ plane @ np.linalg.inv(one) @ middle, np.float64)
