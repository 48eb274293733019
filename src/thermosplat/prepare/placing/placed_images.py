"""Places of thermal images of another hour in the photographs' scene.

The method is that of edges which do not depend on the spectrum, searched and adjusted from coarse to fine:

1. Each image is searched alone from where GPS has it, with the directions of photographs near it and quarter turns of
   them. The focal length is the one by which some images agree best.
2. All poses, the lens and the common error of GPS are adjusted together, and images are searched again from there.
3. Placed images tell which edges of photographs are edges of temperature (``thermal_contours``). With these alone each
   image is searched again, from several places around where GPS has it, and the best is kept.

An image counts as placed if it shows what others show there, about as well as most do, and if it lies where GPS has it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.evenly_chosen import evenly_chosen
from thermosplat.prepare.placing.adjustment import Adjusted, Scene, adjusted, aligned
from thermosplat.prepare.placing.directions_beside import BESIDE, turned_from_beside
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, Field, Trial, best_trial
from thermosplat.prepare.placing.straight_pieces import straight_pieces
from thermosplat.prepare.placing.thermal_contours import Contours, agreement, contours, spread
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
_PLAIN, _WITH_CONTOURS = 3, 3
"""Rounds of both kinds."""
_EDGES_OF_PLAIN, _EDGES_OF = 3, 5
"""Photographs whose edges an image is compared with."""
_STARTS = 1.5 * np.concatenate([np.eye(3), -np.eye(3)])
"""Places around one from which an image is searched [standard deviations of GPS]."""
_CLEAR = 1.15
"""How many times as well as elsewhere edges must agree for an image to be asked first what thermal images show."""
_NOT_TURNED = 1 + 2 * np.cos(np.radians(25.0))
"""Trace of the largest turn of an image's last pose against its neighbours' direction."""
_OF_USUAL, _OFF_GPS, _LEAST_SPREAD, _TIMES_TURNED = 0.7, 4.0, 0.05, 5.0
"""Share of the usual agreement, standard deviations from GPS, spread of what is shown [image widths], and turn against
the images beside it [of the usual one], beyond which an image is not placed: edges in a corner say little of the rest.
Chosen on rendered flights."""
_ALL = ("log_f", "k1", "cx", "cy", "k2")
_PLAIN_STEPS = [
    *[(_ALL[:1], 10.0, 4.0)] * 3,
    *[(_ALL[:2], 8.0, 3.0)] * 5,
    *[(_ALL[:4], 5.0, 2.0)] * 5,
]
_FINE_STEPS = [*[(_ALL, 3.0, 1.25)] * 4, *[(_ALL, 2.0, 0.75)] * 4, *[(_ALL, 1.5, 0.5)] * 4]
_ALONE_STEPS = [*[(5.0, 2.0)] * 3, *[(3.0, 1.25)] * 3, *[(2.0, 0.75)] * 2]
"""Windows of the adjustments: the lens follows when poses are about right."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Thermal images in the world.

    Args:
        known: Lens and poses of all images.
        right: Those that are placed; the poses of the others mean nothing.
        share: Usual share of what others show that an image shows, less what it would show by chance.
    """

    known: Adjusted
    right: Sequence[int]
    share: float


def placed_images(photographs: Photographs, slopes: Sequence[NDArray[np.float32]], gps: Array) -> Placement:
    """Place thermal images.

    Args:
        photographs: The photographs.
        slopes: Slopes [H, W, 2] of each thermal image, in the order in which they were taken.
        gps: Where GPS has each in the world, [N, 3].
    """
    fields = [edge_field(field, working_width=SEARCH_WIDTH) for field in slopes]
    scene = Scene(photographs, slopes, gps, _EDGES_OF_PLAIN)
    lens = _first_lens(scene, fields)
    pieces = straight_pieces(gps)
    known = Adjusted(lens, {}, np.zeros(3), _DEVIATION)
    everyone = range(len(slopes))
    with progress_bar("places", (_PLAIN + _WITH_CONTOURS) * len(slopes)) as advance:
        for round_number in range(_PLAIN):
            first = round_number == 0
            trials = {}
            for number in everyone:
                place = gps[number] - known.common_error
                turns, reach = (_FIRST_TURNS, _FIRST_REACH) if first else (_TURNS, _REACH)
                trials[number] = _searched(scene, fields[number], place, known.lens, turns, reach)
                advance(1)
            poses = {number: trial.pose for number, trial in trials.items()}
            known = adjusted(scene, replace(known, poses=poses, deviation=_DEVIATION), _PLAIN_STEPS)
        scene = replace(scene, edges_of=_EDGES_OF)
        right, share = [number for number, trial in trials.items() if trial.clear > _CLEAR], 0.0
        for _ in range(_WITH_CONTOURS):
            shown = contours(scene, known, right)
            poses = {}
            for number in everyone:
                beside = _beside(number, pieces, right)
                poses[number] = _best_of_starts(scene, number, fields[number], known, shown, beside)
                advance(1)
            weights = {number: shown.weights(number) for number in everyone}
            known = adjusted(scene, replace(known, poses=poses), _FINE_STEPS, weights)
            right, share = _sound(scene, known, weights)
    return Placement(known, right, share)


def _first_lens(scene: Scene, fields: Sequence[Field]) -> RigCamera:
    """The lens without distortion by which some images agree best with the photographs."""
    height, width = scene.slopes[0].shape[:2]
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
    return same[:BESIDE] or [one for one in near if 0 < abs(one - number) <= BESIDE] or [number]


def _best_of_starts(
    scene: Scene, number: int, field: Field, known: Adjusted, shown: Contours, beside: Sequence[int]
) -> Pose:
    """The pose of one image that shows best what the others show, and lies where GPS has it.

    Both are judged in standard deviations: edges by their number, as if each were met by chance, GPS by half its
    square, as likelihoods are.
    """
    weights, place = shown.weights(number), scene.gps[number] - known.common_error

    def search(pose: Pose, turns: Sequence[float], reach: float) -> Trial:
        return best_trial(
            field,
            scene.photographs,
            [pose],
            known.lens,
            turns,
            edges_of=scene.edges_of,
            reach=reach,
            weights=weights,
        )

    def best_of(poses: Sequence[Pose]) -> tuple[float, Pose]:
        ended = [aligned(scene, number, pose, known, _ALONE_STEPS, weights) for pose in poses]
        off = [float(np.linalg.norm(pose.centre - place)) / known.deviation for pose in ended]
        shows = [agreement(scene, number, pose, known.lens, weights)[0] for pose in ended]
        return max(zip(np.subtract(shows, np.square(off) / 2), ended), key=lambda one: one[0])

    first = [search(Pose(known.poses[near].rotation, place), _TURNS, _REACH) for near in beside]
    most, best = best_of([pose for trial in first for pose in (trial.pose, trial.other)])
    if np.trace(known.poses[number].rotation @ best.rotation.T) > _NOT_TURNED:
        most, best = max((most, best), best_of([known.poses[number]]), key=lambda one: one[0])
    for middle in (place, best.centre):
        starts = [Pose(best.rotation, start) for start in middle + known.deviation * _STARTS]
        found = best_of([search(start, _LAST_TURNS, _LAST_REACH).pose for start in starts])
        most, best = max((most, best), found, key=lambda one: one[0])
    return best


def _sound(scene: Scene, known: Adjusted, weights: Mapping[int, Array]) -> tuple[list[int], float]:
    """The images that are placed, and the usual share of what others show that an image shows."""
    lens = known.lens
    shares = {n: agreement(scene, n, pose, lens, weights[n])[1] for n, pose in known.poses.items()}
    usual = float(np.median(list(shares.values())))
    off = {n: np.linalg.norm(scene.gps[n] - known.common_error - pose.centre) for n, pose in known.poses.items()}
    turned = turned_from_beside({n: pose.rotation for n, pose in known.poses.items()})
    most_turned = _TIMES_TURNED * float(np.median(list(turned.values())))
    right = [
        n
        for n, pose in known.poses.items()
        if turned[n] <= most_turned
        and shares[n] > _OF_USUAL * usual
        and off[n] < _OFF_GPS * known.deviation
        and spread(scene, n, pose, lens, weights[n]) > _LEAST_SPREAD
    ]
    return right, usual
