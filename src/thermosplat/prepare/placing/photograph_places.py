"""Where thermal images were taken, without GPS: about where photographs were.

Each image is compared with the edges that each photograph's place shows, in all quarter turns. Chance agrees as well as
one true place in two. So images that were taken one after another decide together: the best path through places
(Viterbi, 1967) changes them little from image to image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.placing.shift_search import Field, Sought, View, turned
from thermosplat.prepare.placing.world_edges import PER_RADIAN, Photographs, Pose
from thermosplat.prepare.registration.edge_correlation import QUARTERS, rotation_between
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

WIDTH = 80
"""Width [px] at which edges are compared: a search through all photographs takes a quarter of the time."""
_REACH = 0.25
"""Largest shift [image widths]: half the way to the next photograph of a flight that overlaps by 80%, and a tilt."""
_MOST_PLACES = 200
"""Photographs near which images are looked for: the time grows with their number times that of images. Open choice."""
_PER_SPACING, _AT_MOST = 0.3, 2.0
"""What a step to a place as far as photographs are from each other costs, and any step at most [standard deviations of
the agreement at wrong places]. Open choice."""


class Path(NamedTuple):
    """The places of thermal images.

    Args:
        moved: Of each, at a place beside a photograph's, about as that one looks: it shows the same of a plane.
        score: How well they agree, the more the better.
    """

    moved: list[Pose]
    score: float


def asked_places(photographs: Photographs) -> list[Pose]:
    """Poses of photographs near which images are looked for: all, or some spread over them."""
    return evenly_chosen(photographs.poses, _MOST_PLACES)


def _distances(poses: Sequence[Pose]) -> Array:
    """Distances of cameras, [poses, poses]."""
    centres = np.array([pose.centre for pose in poses])
    apart: Array = np.linalg.norm(centres[:, None] - centres, axis=2)
    return apart


def turns_between(poses: Sequence[Pose]) -> Array:
    """Angles [rad] by which cameras are turned from each other, [poses, poses]."""
    traces = np.einsum("aij,bij->ab", *[[pose.rotation for pose in poses]] * 2)
    angles: Array = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    return angles


def spacing(poses: Sequence[Pose]) -> float:
    """Median distance of cameras from the nearest one elsewhere."""
    apart = _distances(poses)
    return float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))


@dataclass(frozen=True, eq=False)
class Agreements:
    """How well thermal images agree with what is seen near photographs.

    Args:
        photographs: The photographs.
        lens: The thermal lens.
        edges_of: How many photographs' edges are drawn.
        starts: Poses near which each image was searched: of photographs, in quarter turns.
        scores: Best score of each image near each of them, [images, starts].
        found: The poses that have these scores, by image and start: turned, not moved.
    """

    photographs: Photographs
    lens: RigCamera
    edges_of: int
    starts: Sequence[Pose]
    scores: Array
    found: Mapping[tuple[int, int], Pose]

    def path(self) -> Path:
        """The path of the images past the photographs."""
        numbers, score = _best_path(_beyond_chance(self.scores), _steps(self.starts))
        return Path([self.moved(image, number) for image, number in enumerate(numbers)], score)

    def moved(self, image: int, number: int) -> Pose:
        """A pose that looks where a start does and sees in its middle what the found one does, which is turned."""
        start, pose = self.starts[number], self.found[image, number]
        seen = self.photographs.before(start.camera(self.lens), self.photographs.near(start, self.edges_of))
        points = self.photographs.edges.points[seen]
        depth = float(np.median((points - start.centre) @ start.rotation[2])) if len(points) else 0.0
        towards = start.rotation @ pose.rotation[2]
        back = rotation_between(pose.rotation @ start.rotation[2], np.array([0.0, 0.0, 1.0]))
        return Pose(back @ pose.rotation, start.centre + depth * (towards / towards[2] - [0, 0, 1]) @ start.rotation)


def agreements(
    photographs: Photographs,
    fields: Sequence[Field],
    lens: RigCamera,
    turns: Sequence[float],
    *,
    edges_of: int,
    weights: Array | None = None,
) -> Agreements:
    """Thermal images compared with what is seen near all photographs.

    Args:
        photographs: The photographs.
        fields: Edges of the images at ``WIDTH``, in the order in which they were taken.
        lens: The thermal lens.
        turns: Turns about the optical axis that are tried [°].
        edges_of: How many photographs' edges are drawn.
        weights: How much each edge point of the photographs counts, 0 to 1; None: all alike.
    """
    images = [Sought.of(field) for field in fields]
    starts = [turned(pose, quarter) for pose in asked_places(photographs) for quarter in QUARTERS]
    scores = np.full((len(images), len(starts)), -np.inf)
    found: dict[tuple[int, int], Pose] = {}
    for number, start in enumerate(starts):
        near = photographs.near(start, edges_of)
        for turn in turns:
            view = View.of(photographs, near, turned(start, turn), lens, images[0].shape, weights)
            for image, sought in enumerate(images):
                [(score, pose)] = view.peaks(sought, _REACH, most=1)
                if score > scores[image, number]:
                    scores[image, number], found[image, number] = score, pose
    return Agreements(photographs, lens, edges_of, starts, scores, found)


def _beyond_chance(scores: Array) -> Array:
    """Scores [images, starts] in standard deviations: some places agree with all images, some images with any place."""
    for axis in (0, 1):
        scores = scores - scores.mean(axis, keepdims=True)
        scores = scores / (scores.std(axis, keepdims=True) + 1e-9)
    return scores


def _steps(starts: Sequence[Pose]) -> Array:
    """What each step costs, [starts, starts]."""
    apart = _distances(starts) / spacing(starts)
    return np.minimum(_PER_SPACING * (apart + PER_RADIAN * turns_between(starts)), _AT_MOST)


def _best_path(scores: Array, steps: Array) -> tuple[NDArray[np.int64], float]:
    """The starts along which the sum of scores, less the steps between them, is largest; and that sum."""
    best, before = scores[0], []
    for own in scores[1:]:
        through = best[:, None] - steps
        before.append(through.argmax(axis=0))
        best = through.max(axis=0) + own
    path = [int(best.argmax())]
    for earlier in reversed(before):
        path.append(int(earlier[path[-1]]))
    return np.array(path[::-1]), float(best.max())
