"""What is known of the places of thermal images without GPS: the best path past the photographs.

The focal length is the one whose path is best. Once some images are placed, edges of temperature tell the path of the
others far better than all edges do. What is still missing is searched near all photographs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from thermosplat.prepare.placing.about_placed import Prior
from thermosplat.prepare.placing.adjustment import FINE_STEPS, Adjusted, adjusted, aligned
from thermosplat.prepare.placing.lone_search import ALONE, best_pose
from thermosplat.prepare.placing.photograph_places import (
    WIDTH,
    Agreements,
    agreements,
    asked_places,
    spacing,
    turns_between,
)
from thermosplat.prepare.placing.shift_search import Field
from thermosplat.prepare.placing.soundness import sound
from thermosplat.prepare.placing.thermal_looks import (
    EDGES_OF_PLAIN,
    Expected,
    Scene,
    Shown,
    ThermalImage,
    edges_shown,
    likeness,
    shown_by,
)
from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, edge_field
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

_ASKED = 48
"""Images one after another whose path tells the focal length. Open choice."""
_TURNS = (-4.0, 0.0, 4.0)
_OF_SPACING = 0.25
"""Standard deviation of places on a path [spacings of photographs]: on a rendered flight two in three are as near to
the truth as half a spacing."""
_TRIED = 16
"""Places from which an image that may be anywhere is searched."""
_SOON, _MOST_TURNED, _LEAST_USUAL = 3, 6.0, np.radians(0.5)
"""Images before and after one, how many times as usual it may be turned, from image to image, from the second nearest
of them, and what is taken for usual at least [rad]. Three real and five rendered captures turn up to 3.8 times as
usual, wrong images of a flight from 8 times on. The least is an open choice."""
_LEAST_OF_SPACING = 1 / 32
"""The same of places to which a search leads back. Open choice."""


def prior_on_path(photographs: Photographs, images: Sequence[ThermalImage]) -> Prior:
    """About where images were taken.

    Args:
        photographs: The photographs.
        images: The thermal images, in the order in which they were taken.
    """
    fields = [edge_field(image.slopes, working_width=WIDTH) for image in images]
    lens = _first_lens(photographs, images, fields)
    path = agreements(photographs, fields, lens, _TURNS, edges_of=EDGES_OF_PLAIN).path()
    deviation = _OF_SPACING * spacing(asked_places(photographs))
    return Prior(np.array([pose.centre for pose in path.moved]), deviation, deviation)


def placed_again(scene: Scene, known: Adjusted, everyone: bool) -> tuple[Scene, Adjusted]:
    """Images that are not placed so far, from where a path past edges of temperature has them, beside those that are.

    Args:
        scene: Edges and places.
        known: All poses so far.
        everyone: Those that are placed are searched, too, from where they are. Right poses lead back there.
    """
    unit = spacing(asked_places(scene.photographs))
    deviation = _OF_SPACING * unit
    right, _ = sound(scene, replace(known, deviation=deviation))
    shown = shown_by(scene, known.poses, known.lens, right)
    path = _agreements_by(scene, known.lens, range(len(scene.images)), shown.without(None).weights).path()
    starts = {number: known.poses[number] if number in right else pose for number, pose in enumerate(path.moved)}
    least = _LEAST_OF_SPACING * unit if everyone else deviation
    scene = scene._replace(places=np.array([pose.centre for pose in starts.values()]), deviation=least)
    known = replace(known, poses=starts, common_error=np.zeros(3), deviation=deviation)
    poses = dict(starts)
    with progress_bar("places", len(poses)) as advance:
        for number, pose in starts.items():
            if everyone or number not in right:
                poses[number] = best_pose(scene, number, known, shown.without(number), [pose.rotation])
            advance(1)
    return scene, adjusted(scene, replace(known, poses=poses), FINE_STEPS, shown)


def searched_anywhere(scene: Scene, known: Adjusted, shown: Shown, numbers: Sequence[int]) -> dict[int, Pose]:
    """The poses of some images near any photograph, by the edges and looks that trusted images show.

    Args:
        scene: Edges and places.
        known: The lens, and all poses so far.
        shown: What trusted images show.
        numbers: The images that are searched.
    """
    if not numbers:
        return {}
    near = _agreements_by(scene, known.lens, numbers, shown.without(None).weights)
    deviation = _OF_SPACING * spacing(asked_places(scene.photographs))
    alone = replace(known, common_error=np.zeros(3), deviation=deviation)
    found: dict[int, Pose] = {}
    with progress_bar("anywhere", len(numbers)) as advance:
        for image, number in enumerate(numbers):
            starts = [int(start) for start in np.argsort(-near.scores[image])[:_TRIED]]
            tried = [*(near.found[image, start] for start in starts), *(near.moved(image, start) for start in starts)]
            found[number] = _best_of(scene, number, alone, shown.without(number), tried)
            advance(1)
    return found


def on_the_path(poses: Mapping[int, Pose], numbers: Sequence[int]) -> list[int]:
    """Those images that are hardly turned from two others, at least, which were taken soon before and after them.

    Args:
        poses: Their poses.
        numbers: The images, in the order in which they were taken.
    """
    if len(numbers) <= 2:
        return list(numbers)
    order = np.array(numbers)
    later = np.abs(order[:, None] - order)
    turns = turns_between([poses[number] for number in numbers]) / np.maximum(later, 1)
    turns = np.sort(np.where((later > 0) & (later <= _SOON), turns, np.inf), axis=1)[:, 1]
    usual = max(float(np.median(turns)), _LEAST_USUAL)
    return [number for number, turn in zip(numbers, turns) if turn < _MOST_TURNED * usual]


def _best_of(scene: Scene, number: int, known: Adjusted, expected: Expected, tried: Sequence[Pose]) -> Pose:
    """The pose by which an image shows most edges and looks most alike: its last one, or one that others lead to."""

    def about(place: Array) -> Scene:
        return scene._replace(places=np.where(np.arange(len(scene.places))[:, None] == number, place, scene.places))

    def judged(pose: Pose, place: Array) -> float:
        _, more = edges_shown(scene, number, pose, known.lens, expected.weights)
        off = float(np.linalg.norm(pose.centre - place)) / known.deviation
        return max(0.0, likeness(scene, number, pose, known.lens, expected)) * more - off**2 / 2

    last = known.poses[number]
    ended = [(aligned(about(pose.centre), number, pose, known, ALONE, expected), pose.centre) for pose in tried]
    best, _ = max([(last, last.centre), *ended], key=lambda one: judged(*one))
    alone = replace(known, poses={number: best})
    again = best_pose(about(best.centre), number, alone, expected, [best.rotation])
    return max((best, again), key=lambda pose: judged(pose, best.centre))


def _agreements_by(scene: Scene, lens: RigCamera, numbers: Sequence[int], weights: Array) -> Agreements:
    """Of some images, by edges that count so much."""
    fields = [edge_field(scene.images[number].slopes, working_width=WIDTH) for number in numbers]
    return agreements(scene.photographs, fields, lens, _TURNS, edges_of=scene.edges_of, weights=weights)


def _first_lens(photographs: Photographs, images: Sequence[ThermalImage], fields: Sequence[Field]) -> RigCamera:
    """The lens without distortion with the best path: every second one, as edges agree at 7% beside, too."""
    height, width = images[0].slopes.shape[:2]
    first = max(0, len(fields) - _ASKED) // 2
    lenses = [RigCamera.looking_along(width, height, factor * width) for factor in FOCAL_LENGTHS[::2]]
    scores = []
    with progress_bar("focal length", len(lenses)) as advance:
        for lens in lenses:
            asked = fields[first : first + _ASKED]
            scores.append(agreements(photographs, asked, lens, (0.0,), edges_of=EDGES_OF_PLAIN).path().score)
            advance(1)
    return lenses[int(np.argmax(scores))]
