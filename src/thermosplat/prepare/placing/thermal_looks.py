"""What placed thermal images show at the edge points of photographs, and how well another image agrees with it.

Print, shadows and cracks have no contour in thermal images, and outlines of warm roofs have one in each image. So once
some images are placed, each edge point has a share of images that show an edge there. It also has a look: the mean of
the locally normalised values there, coarse and fine. Images of one hour share looks far more closely than edges of
photographs and of temperature agree. An image is judged by what others show, never by itself.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.registration.edge_alignment import LEAST_SLOPE, projected, slopes_across
from thermosplat.prepare.registration.rig_camera import Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import sampled
from thermosplat.prepare.registration.thermal_edges import normalised, slopes_of

SCALES = (2, 1)
"""Pixels of the image in one of each look: the coarse one draws poses from farther away."""
EDGES_OF_PLAIN, EDGES_OF = 3, 5
"""Photographs whose edges an image is compared with, all edges and then those of temperature."""
_WITHIN = np.arange(-1.0, 1.1, 0.5)
"""Offsets [px] along the normal at which an edge is met."""
_ASIDE = 8.0
"""Offset [px] at which edges meet by chance."""
_BEFORE, _OF = 0.3, 1.0
"""What is taken for known of an edge point before any image: so many of so many images show it. Open choice."""
_BY_CHANCE, _SURELY = 0.15, 0.75
"""Shares of images from which on an edge point counts, and counts fully: noise meets one in seven."""

Picture = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ThermalImage:
    """A thermal image as it is compared.

    Args:
        slopes: Slopes [H, W, 2] of the locally normalised image.
        looks: The locally normalised image at each of ``SCALES``, [H / scale, W / scale].
    """

    slopes: Picture
    looks: Sequence[Picture]

    @classmethod
    def of(cls, image: NDArray[np.generic]) -> "ThermalImage":
        """Of values [H, W] in any unit."""
        values = image.astype(np.float32)
        height, width = values.shape
        sizes = [(width // scale, height // scale) for scale in SCALES]
        looks = [normalised(cv2.resize(values, size, interpolation=cv2.INTER_AREA)) for size in sizes]
        return cls(slopes_of(looks[-1]), looks)

    def look(self, scale: int, pixels: Array) -> Array:
        """Values [N] of one of the looks, by its number, at pixels [N, 2] of the image."""
        look = self.looks[scale]
        return np.asarray(sampled(look, pixels / SCALES[scale] - 0.5), np.float64)

    def look_slopes(self, scale: int, pixels: Array) -> Array:
        """Slopes [N, 2] of that look [per px of the image]."""
        half = SCALES[scale] / 2 * np.eye(2)
        return np.stack(
            [(self.look(scale, pixels + to) - self.look(scale, pixels - to)) / SCALES[scale] for to in half], axis=1
        )


class Scene(NamedTuple):
    """What poses are judged by."""

    photographs: Photographs
    images: Sequence[ThermalImage]
    """The thermal images."""
    places: Array
    """About where each was taken, by GPS or by the photographs it resembles, [N, 3]."""
    deviation: float
    """Standard deviation of these places by axis, at least [world units]."""
    edges_of: int
    """The edges of how many photographs an image is compared with."""

    def before(self, pose: Pose, lens: RigCamera, weights: Array | None = None) -> NDArray[np.int64]:
        """Numbers of the edge points that an image may see."""
        return self.photographs.before(pose.camera(lens), self.photographs.near(pose, self.edges_of), weights)


@dataclass(frozen=True, eq=False)
class Expected:
    """What an image should show at each edge point, by all others.

    Args:
        weights: How much it counts as an edge, 0 to 1, [N].
        looks: Its looks, [N, scales].
        seen: How many images tell, [N].
    """

    weights: Array
    looks: Array
    seen: Array


@dataclass(frozen=True, eq=False)
class Shown:
    """What placed images show at the edge points of photographs.

    Args:
        seen: How many images have each edge point inside, [N].
        total: How many of them show an edge there, and the sum of their looks, [N, 1 + scales].
        images: Numbers of the edge points that each has inside, and what it adds to the total.
        own: Numbers of the edge points that are contours of its own.
    """

    seen: Array
    total: Array
    images: Mapping[int, tuple[NDArray[np.int64], Array]]
    own: Mapping[int, slice]

    def without(self, number: int | None) -> Expected:
        """What all images but one tell, by edges that are not its own contours."""
        if number is None:
            return self._by_all
        weights, looks, seen = self._by_all.weights.copy(), self._by_all.looks.copy(), self.seen.copy()
        if number in self.own:
            weights[self.own[number]] = seen[self.own[number]] = 0
        if number in self.images:
            points, mine = self.images[number]
            seen[points] = np.maximum(seen[points] - 1, 0)
            weights[points], looks[points] = _told(self.total[points] - mine, seen[points])
        return Expected(weights, looks, seen)

    @cached_property
    def _by_all(self) -> Expected:
        return Expected(*_told(self.total, self.seen), self.seen)


def _told(total: Array, seen: Array) -> tuple[Array, Array]:
    """Weights [N] and looks [N, scales] by how many images show an edge and the sum of their looks."""
    share = ((total[:, 0] + _BEFORE) / (seen + _OF) - _BY_CHANCE) / (_SURELY - _BY_CHANCE)
    return np.where(seen > 0, share.clip(0, 1), 0.0), total[:, 1:] / np.maximum(seen, 1)[:, None]


def shown_by(scene: Scene, poses: Mapping[int, Pose], lens: RigCamera, trusted: Collection[int]) -> Shown:
    """What some images show.

    Args:
        scene: Photographs and images.
        poses: Poses by the image's number.
        lens: Their lens.
        trusted: Which images.
    """
    count = len(scene.photographs.edges.points)
    seen, total = np.zeros(count), np.zeros((count, 1 + len(SCALES)))
    images = {}
    for number in trusted:
        points, pixels, met = _met(scene, number, poses[number], lens, scene.before(poses[number], lens), (0.0,))
        looks = [scene.images[number].look(scale, pixels) for scale in range(len(SCALES))]
        images[number] = points, np.column_stack([met[0], *looks])
        seen[points] += 1
        total[points] += images[number][1]
    return Shown(seen, total, images, scene.photographs.of_placed())


def edges_shown(scene: Scene, number: int, pose: Pose, lens: RigCamera, weights: Array) -> tuple[float, float]:
    """Share of the weight of edge points that an image shows, less what it would show by chance; and how many more."""
    points, _, met = _met(scene, number, pose, lens, scene.before(pose, lens, weights), (0.0, -_ASIDE, _ASIDE))
    shown, inside = met.astype(np.float64) @ weights[points], max(float(weights[points].sum()), 1.0)
    share = float(shown[0] - (shown[1] + shown[2]) / 2) / inside
    return share, share * float(np.sqrt(inside))


def compared(
    scene: Scene, pose: Pose, lens: RigCamera, scale: int, expected: Expected
) -> tuple[NDArray[np.int64], Array, Array]:
    """Edge points [N] inside an image that others show, their pixels [N, 2], and what others show there at a scale."""
    points = scene.before(pose, lens)
    points = points[expected.seen[points] > 0]
    pixels, depth = pose.camera(lens).project(scene.photographs.edges.points[points])
    inside = (depth > 0) & (pixels > 0).all(1) & (pixels < [lens.width, lens.height]).all(1)
    return points[inside], pixels[inside], expected.looks[points[inside], scale]


def likeness(scene: Scene, number: int, pose: Pose, lens: RigCamera, expected: Expected) -> float:
    """Correlation of an image's finest look with that of the others."""
    _, pixels, theirs = compared(scene, pose, lens, -1, expected)
    look = scene.images[number].look(-1, pixels)
    return float(look @ theirs / np.sqrt((look @ look) * (theirs @ theirs) + 1e-12))


def _met(
    scene: Scene, number: int, pose: Pose, lens: RigCamera, points: NDArray[np.int64], asides: Sequence[float]
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Edge points inside an image, their pixels, and whether it shows an edge near them or so far aside [px]."""
    edges = scene.photographs.some(points)
    chosen, pixels, normals = projected(pose.camera(lens), edges)
    offsets = np.add.outer(asides, _WITHIN).ravel()
    slope = slopes_across(edges, chosen, pixels, normals, [scene.images[number].slopes], offsets)
    met = slope.reshape(len(chosen), len(asides), len(_WITHIN)).max(2, initial=0.0) > LEAST_SLOPE
    return points[chosen], pixels, met.T
