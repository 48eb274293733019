"""Which edges of photographs are edges of temperature, too: those that other thermal images show.

Print, shadows and cracks have no contour in thermal images, and outlines of warm roofs have one in each image. So once
some images are placed, each edge point has a share of images that show an edge there. An image is judged by what others
show, never by itself.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.placing.adjustment import Adjusted, Scene
from thermosplat.prepare.placing.world_edges import Pose
from thermosplat.prepare.registration.edge_alignment import LEAST_SLOPE, projected, slopes_across
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

_WITHIN = np.arange(-1.0, 1.1, 0.5)
"""Offsets [px] along the normal at which an edge is met."""
_ASIDE = 8.0
"""Offset [px] at which edges meet by chance."""
_BEFORE, _OF = 0.3, 1.0
"""What is taken for known of an edge point before any image: so many of so many images show it. Open choice."""
_BY_CHANCE, _SURELY = 0.15, 0.75
"""Shares of images from which on an edge point counts, and counts fully: noise meets one in seven."""

_FEWEST_SHOWN = 3
"""Edge points that have a spread."""


@dataclass(frozen=True, eq=False)
class Contours:
    """What placed images show at the edge points of photographs.

    Args:
        seen: How many images have each edge point inside, [N].
        shown: How many of them show an edge there, [N].
        images: Numbers of the edge points that each has inside, and whether it shows them.
    """

    seen: Array
    shown: Array
    images: Mapping[int, tuple[NDArray[np.int64], NDArray[np.bool_]]]

    def weights(self, without: int) -> Array:
        """How much each edge point counts, 0 to 1, by all images but one."""
        seen, shown = self.seen.copy(), self.shown.copy()
        if without in self.images:
            numbers, met = self.images[without]
            seen[numbers] -= 1
            shown[numbers] -= met
        share = np.clip(((shown + _BEFORE) / (seen + _OF) - _BY_CHANCE) / (_SURELY - _BY_CHANCE), 0, 1)
        return np.where(seen > 0, share, 0.0)


def contours(scene: Scene, known: Adjusted, trusted: Collection[int]) -> Contours:
    """What some images show.

    Args:
        scene: Edges and positions.
        known: The images' poses and their lens.
        trusted: Which images.
    """
    seen, shown = np.zeros((2, len(scene.photographs.edges.points)))
    images = {}
    for number in trusted:
        numbers, met = _met(scene, number, known.poses[number], known.lens, 0.0)
        seen[numbers] += 1
        shown[numbers] += met
        images[number] = numbers, met
    return Contours(seen, shown, images)


def agreement(scene: Scene, number: int, pose: Pose, lens: RigCamera, weights: Array) -> tuple[float, float]:
    """How well an image shows what the others show.

    Returns:
        The weight of edge points that it shows less what it would show by chance, first over the square root of that
        of all inside, by which poses compare, then as a share of it.
    """
    weight = [
        (weights[numbers[met]].sum(), weights[numbers].sum())
        for numbers, met in (_met(scene, number, pose, lens, aside, weights) for aside in (0.0, -_ASIDE, _ASIDE))
    ]
    above = weight[0][0] - (weight[1][0] + weight[2][0]) / 2
    inside = max(weight[0][1], 1.0)
    return float(above / np.sqrt(inside)), float(above / inside)


def spread(scene: Scene, number: int, pose: Pose, lens: RigCamera, weights: Array) -> float:
    """Standard deviation [image widths] of the shown edge points' places across the line that they lie nearest to."""
    numbers, met = _met(scene, number, pose, lens, 0.0, weights)
    shown = numbers[met]
    if len(shown) < _FEWEST_SHOWN:
        return 0.0
    pixels, _ = pose.camera(lens).project(scene.photographs.edges.points[shown])
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(pixels.T, aweights=weights[shown])).clip(0)[0])) / lens.width


def _met(
    scene: Scene, number: int, pose: Pose, lens: RigCamera, aside: float, weights: Array | None = None
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Edge points inside an image, and whether it shows an edge near them, or so far aside [px]."""
    camera = pose.camera(lens)
    numbers = scene.photographs.before(camera, scene.photographs.near(pose, scene.edges_of), weights)
    edges = scene.photographs.some(numbers)
    chosen, pixels, normals = projected(camera, edges)
    slope = slopes_across(edges, chosen, pixels, normals, [scene.slopes[number]], _WITHIN + aside)
    return numbers[chosen], slope.max(1, initial=0.0) > LEAST_SLOPE
