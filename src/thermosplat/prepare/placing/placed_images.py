"""Places of thermal images of another hour in the photographs' scene.

The method is that of edges which do not depend on the spectrum, searched and adjusted from coarse to fine, and then of
what thermal images show alike:

1. Each image is searched alone from where GPS has it, with the directions of photographs near it and quarter turns of
   them. The focal length is the one by which some images agree best.
2. All poses, the lens and the common error of GPS are adjusted together, and images are searched again from there.
3. Placed images tell which edges of photographs are edges of temperature (``thermal_looks``). With these alone each
   image is searched again, from several places around where GPS has it, and the best is kept.
4. An image counts as placed if it shows what the others show there, about as well as most do, and if it lies where GPS
   has it. It shows edges and a look. Nothing was drawn to looks so far, so that wrong images with many edges look
   unlike the others.
5. The placed ones are adjusted together by edges and looks, and judged again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.evenly_chosen import evenly_chosen
from thermosplat.prepare.placing.adjustment import Adjusted, adjusted, aligned
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, Field, Trial, best_trial
from thermosplat.prepare.placing.straight_pieces import straight_pieces
from thermosplat.prepare.placing.thermal_looks import (
    Expected,
    Scene,
    ThermalImage,
    edges_shown,
    likeness,
    shown_by,
)
from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, QUARTERS, edge_field, turn_about_axis
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

_ASKED = 16
"""Images that tell the focal length."""
_NEAR_BY_GPS, _DIRECTIONS_APART = 8, np.cos(np.radians(15.0))
"""Photographs near an image whose directions are tried, and the cosine of the angle from which two are different."""
_FIRST_REACH, _REACH, _LAST_REACH = 0.19, 0.14, 0.09
"""Largest shifts [image widths] of the searches: a tilt of 3° and GPS that is wrong by metres, then by decimetres."""
_FIRST_TURNS, _TURNS, _LAST_TURNS = (-4.0, 0.0, 4.0), (-4.0, -2.0, 0.0, 2.0, 4.0), (-1.5, 0.0, 1.5)
_DEVIATION = 0.5
"""Standard deviation [m] of GPS from image to image to begin with. Open choice."""
_PLAIN = 3
"""Rounds by all edges, before the one by those of temperature."""
_EDGES_OF_PLAIN, _EDGES_OF = 3, 5
"""Photographs whose edges an image is compared with."""
_BESIDE = 3
"""Images before and after one that are beside it."""
_STARTS = 1.5 * np.concatenate([np.eye(3), -np.eye(3)])
"""Places around one from which an image is searched [standard deviations of GPS]."""
_CLEAR = 1.15
"""How many times as well as elsewhere edges must agree for an image to be asked first what thermal images show."""
_NOT_TURNED = 1 + 2 * np.cos(np.radians(25.0))
"""Trace of the largest turn of an image's last pose against its neighbours' direction."""
_OF_USUAL, _OFF_GPS = 0.46, 5.0
"""Share of what is usual that edges times looks are at least, and standard deviations from GPS at most, for an image to
be placed. Chosen on rendered flights."""
_ALL = ("log_f", "k1", "cx", "cy", "k2")
_PLAIN_STEPS = [
    *[(_ALL[:1], (10.0, 4.0, None))] * 3,
    *[(_ALL[:2], (8.0, 3.0, None))] * 5,
    *[(_ALL[:4], (5.0, 2.0, None))] * 5,
]
_FINE_STEPS = [(_ALL, window) for window in ((3.0, 1.25, None), (2.0, 0.75, None), (1.5, 0.5, None)) for _ in range(4)]
_LOOK_STEPS = [[(_ALL, window)] * 3 for window in ((3.0, 1.25, 0), (2.0, 0.75, 1), (2.0, 0.75, 1), (1.5, 0.5, 1))]
_ALONE = [*[(5.0, 2.0, None)] * 3, *[(3.0, 1.25, None)] * 3, *[(2.0, 0.75, None)] * 2]
"""Windows of the adjustments: the lens follows when poses are about right. Of one image alone."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Thermal images in the world.

    Args:
        known: Lens and poses.
        right: The images that are placed; poses of others mean nothing.
        share: Usual share of what others show that an image shows, less what it would show by chance.
    """

    known: Adjusted
    right: Sequence[int]
    share: float


def placed_images(photographs: Photographs, images: Sequence[ThermalImage], gps: Array) -> Placement:
    """Place thermal images.

    Args:
        photographs: The photographs.
        images: The thermal images, in the order in which they were taken.
        gps: Where GPS has each in the world, [N, 3].
    """
    fields = [edge_field(image.slopes, working_width=SEARCH_WIDTH) for image in images]
    scene = Scene(photographs, images, gps, _EDGES_OF_PLAIN)
    known = Adjusted(_first_lens(scene, fields), {}, np.zeros(3), _DEVIATION)
    everyone = range(len(images))
    with progress_bar("places", (_PLAIN + 1) * len(images)) as advance:
        for round_number in range(_PLAIN):
            turns, reach = (_TURNS, _REACH) if round_number else (_FIRST_TURNS, _FIRST_REACH)
            trials = {}
            for number in everyone:
                place = gps[number] - known.common_error
                trials[number] = _searched(scene, fields[number], place, known.lens, turns, reach)
                advance(1)
            poses = {number: trial.pose for number, trial in trials.items()}
            known = adjusted(scene, replace(known, poses=poses, deviation=_DEVIATION), _PLAIN_STEPS)
        clear = [number for number, trial in trials.items() if trial.clear > _CLEAR]
        scene = scene._replace(edges_of=_EDGES_OF)
        shown = shown_by(scene, known.poses, known.lens, clear)
        pieces = straight_pieces(gps)
        poses = {}
        for number in everyone:
            beside = _beside(number, pieces, clear)
            poses[number] = _best(scene, number, fields[number], known, shown.without(number), beside)
            advance(1)
    return _by_looks(scene, adjusted(scene, replace(known, poses=poses), _FINE_STEPS, shown))


def _by_looks(scene: Scene, known: Adjusted) -> Placement:
    """Images that are about placed by edges, adjusted by what they show alike."""
    right, share = _sound(scene, known)
    if not right:
        return Placement(known, right, share)
    known = replace(known, poses={number: known.poses[number] for number in right})
    for steps in _LOOK_STEPS:  # each image moves towards the others, and these move, too
        known = adjusted(scene, known, steps, shown_by(scene, known.poses, known.lens, right))
    right, share = _sound(scene, known)
    return Placement(known, right, share)


def _first_lens(scene: Scene, fields: Sequence[Field]) -> RigCamera:
    """The lens without distortion by which some images agree best with the photographs."""
    height, width = scene.images[0].slopes.shape[:2]
    asked = evenly_chosen(len(fields), _ASKED)
    lenses = [RigCamera.looking_along(width, height, factor * width) for factor in FOCAL_LENGTHS]
    scores = []
    with progress_bar("focal length", len(lenses)) as advance:
        for lens in lenses:
            trials = [_searched(scene, fields[n], scene.gps[n], lens, (0.0,), _FIRST_REACH) for n in asked]
            scores.append(sum(trial.score for trial in trials))
            advance(1)
    return lenses[int(np.argmax(scores))]


def _searched(scene: Scene, field: Field, place: Array, lens: RigCamera, turns: Sequence[float], reach: float) -> Trial:
    """The best pose at a place, with any of the directions of photographs near it."""
    starts: list[Pose] = []
    apart = [np.linalg.norm(pose.centre - place) for pose in scene.photographs.poses]
    for near in np.argsort(apart)[:_NEAR_BY_GPS]:
        rotation = scene.photographs.poses[near].rotation
        if all(rotation[2] @ other.rotation[2] < _DIRECTIONS_APART for other in starts):
            starts.append(Pose(rotation, place))
    quarters = [Pose(turn_about_axis(angle) @ start.rotation, place) for start in starts for angle in QUARTERS]
    return best_trial(field, scene.photographs, quarters, lens, turns, edges_of=scene.edges_of, reach=reach)


def _beside(number: int, pieces: NDArray[np.int64], right: Sequence[int]) -> list[int]:
    """Images that look about the way of another: trusted ones of its straight piece, else before and after, else it."""
    near = sorted(right, key=lambda one: abs(one - number))
    same = [one for one in near if one != number and pieces[one] == pieces[number] >= 0]
    return same[:_BESIDE] or [one for one in near if 0 < abs(one - number) <= _BESIDE] or [number]


def _best(scene: Scene, number: int, field: Field, known: Adjusted, expected: Expected, beside: Sequence[int]) -> Pose:
    """The pose of one image that shows best the edges that others show, and lies where GPS has it.

    Both are judged in standard deviations: edges by their number, GPS by half its square, as likelihoods are.
    """
    place, now = scene.gps[number] - known.common_error, known.poses[number]

    def search(pose: Pose, turns: Sequence[float], reach: float) -> Trial:
        return best_trial(
            field,
            scene.photographs,
            [pose],
            known.lens,
            turns,
            edges_of=scene.edges_of,
            reach=reach,
            weights=expected.weights,
        )

    def best_of(poses: Sequence[Pose]) -> tuple[float, Pose]:
        ended = [aligned(scene, number, pose, known, _ALONE, expected) for pose in poses]
        off = [float(np.linalg.norm(pose.centre - place)) / known.deviation for pose in ended]
        shows = [edges_shown(scene, number, pose, known.lens, expected.weights)[1] for pose in ended]
        return max(zip(np.subtract(shows, np.square(off) / 2), ended), key=lambda one: one[0])

    trials = [search(Pose(known.poses[one].rotation, place), _TURNS, _REACH) for one in beside]
    most, best = best_of([pose for trial in trials for pose in (trial.pose, trial.other)])
    if np.trace(now.rotation @ best.rotation.T) > _NOT_TURNED:
        most, best = max((most, best), best_of([now]), key=lambda one: one[0])
    for middle in (place, best.centre):
        around = [Pose(best.rotation, start) for start in middle + known.deviation * _STARTS]
        ended = best_of([search(start, _LAST_TURNS, _LAST_REACH).pose for start in around])
        most, best = max((most, best), ended, key=lambda one: one[0])
    return best


def _sound(scene: Scene, known: Adjusted) -> tuple[list[int], float]:
    """The images that are placed, and the usual share of what others show that an image shows."""
    lens, poses = known.lens, known.poses
    shown = shown_by(scene, poses, lens, poses)

    def judged(number: int) -> tuple[float, float]:
        expected, pose = shown.without(number), poses[number]
        share, _ = edges_shown(scene, number, pose, lens, expected.weights)
        return share, likeness(scene, number, pose, lens, expected)

    edges, looks = np.array([judged(number) for number in poses]).T
    share = float(np.median(edges))
    shows = edges.clip(0) * looks.clip(0) > _OF_USUAL * share * np.median(looks)
    off = np.array([np.linalg.norm(scene.gps[n] - known.common_error - pose.centre) for n, pose in poses.items()])
    right = shows & (off < _OFF_GPS * known.deviation)
    return [number for number, is_right in zip(poses, right) if is_right], share
