"""Where thermal images were taken, without GPS: about where photographs were.

Each image is compared with the edges that each photograph's place shows, in all quarter turns. Chance agrees as well as
one true place in two. So images that were taken one after another decide together: the best path through places
(Viterbi, 1967) changes them little from image to image.
"""

from collections.abc import Sequence
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
        poses: Of each, at a photograph's place, turned.
        moved: Of each, at a place beside, about as the photograph looks: it shows the same of a plane.
        score: How well they agree, the more the better.
    """

    poses: list[Pose]
    moved: list[Pose]
    score: float


def asked_places(photographs: Photographs) -> list[Pose]:
    """Poses of photographs near which images are looked for: all, or some spread over them."""
    return evenly_chosen(photographs.poses, _MOST_PLACES)


def spacing(poses: Sequence[Pose]) -> float:
    """Median distance of cameras from the nearest one elsewhere."""
    apart = _apart(poses)
    return float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))


def path_through(
    photographs: Photographs,
    fields: Sequence[Field],
    lens: RigCamera,
    turns: Sequence[float],
    *,
    edges_of: int,
    weights: Array | None = None,
) -> Path:
    """The path of thermal images past the photographs.

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
    path, score = _best_path(_beyond_chance(scores), _steps(starts))
    poses = [found[image, number] for image, number in enumerate(path)]
    moved = [_moved(photographs, starts[number], pose, lens, edges_of) for number, pose in zip(path, poses)]
    return Path(poses, moved, score)


def _moved(photographs: Photographs, start: Pose, pose: Pose, lens: RigCamera, edges_of: int) -> Pose:
    """A pose that looks where the start does and sees in its middle what another one does, which is turned from it."""
    points = photographs.edges.points[photographs.before(start.camera(lens), photographs.near(start, edges_of))]
    depth = float(np.median((points - start.centre) @ start.rotation[2])) if len(points) else 0.0
    towards = start.rotation @ pose.rotation[2]
    back = rotation_between(pose.rotation @ start.rotation[2], np.array([0.0, 0.0, 1.0]))
    return Pose(back @ pose.rotation, start.centre + depth * (towards / towards[2] - [0, 0, 1]) @ start.rotation)


def _beyond_chance(scores: Array) -> Array:
    """Scores [images, starts] in standard deviations: some places agree with all images, some images with any place."""
    for axis in (0, 1):
        scores = scores - scores.mean(axis, keepdims=True)
        scores = scores / (scores.std(axis, keepdims=True) + 1e-9)
    return scores


def _steps(starts: Sequence[Pose]) -> Array:
    """What each step costs, [starts, starts]."""
    apart = _apart(starts)
    traces = np.einsum("aij,bij->ab", *[[start.rotation for start in starts]] * 2)
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    return np.minimum(_PER_SPACING * (apart / spacing(starts) + PER_RADIAN * angles), _AT_MOST)


def _apart(poses: Sequence[Pose]) -> Array:
    """Distances of cameras, [poses, poses]."""
    centres = np.array([pose.centre for pose in poses])
    distances: Array = np.linalg.norm(centres[:, None] - centres, axis=2)
    return distances


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
