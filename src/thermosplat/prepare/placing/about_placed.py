"""Thermal images about placed, each from where it was taken about: by GPS, or by a path past the photographs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.placing.adjustment import FINE_STEPS, PLAIN_STEPS, Adjusted, adjusted
from thermosplat.prepare.placing.lone_search import REACH, TURNS, best_pose
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, Field, Trial, best_trial
from thermosplat.prepare.placing.straight_pieces import straight_pieces
from thermosplat.prepare.placing.thermal_looks import EDGES_OF, EDGES_OF_PLAIN, Scene, Shown, ThermalImage, shown_by
from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, QUARTERS, edge_field, turn_about_axis
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

_ASKED = 16
"""Images that tell the focal length."""
_NEAR, _DIRECTIONS_APART = 8, np.cos(np.radians(15.0))
"""Photographs near an image whose directions are tried, and the cosine of the angle from which two are different."""
_FIRST_REACH, _FIRST_TURNS = 0.19, (-4.0, 0.0, 4.0)
"""Largest shift [image widths] of the first search: a tilt of 3° and GPS that is wrong by metres."""
_PLAIN = 3
"""Rounds by all edges, before the one by those of temperature."""
_BESIDE = 3
"""Images before and after one that are beside it."""
_CLEAR = 1.15
"""How many times as well as elsewhere edges must agree for an image to be asked first what thermal images show."""


class Prior(NamedTuple):
    """About where images were taken.

    Args:
        places: Of each, in the order in which they were taken, [N, 3].
        deviation: Standard deviation by axis from image to image, to begin with.
        least: What is taken for it at least, however near the images come.
    """

    places: Array
    deviation: float
    least: float


def about_placed(photographs: Photographs, images: Sequence[ThermalImage], prior: Prior) -> tuple[Scene, Adjusted]:
    """Images about where they were taken.

    Args:
        photographs: The photographs.
        images: The thermal images.
        prior: What is known of their places.
    """
    fields = [edge_field(image.slopes, working_width=SEARCH_WIDTH) for image in images]
    scene = Scene(photographs, images, prior.places, prior.least, EDGES_OF_PLAIN)
    known = Adjusted(_first_lens(scene, fields), {}, np.zeros(3), prior.deviation)
    everyone = range(len(images))
    with progress_bar("places", _PLAIN * len(images)) as advance:
        for round_number in range(_PLAIN):
            turns, reach = (TURNS, REACH) if round_number else (_FIRST_TURNS, _FIRST_REACH)
            trials = {}
            for number in everyone:
                place = prior.places[number] - known.common_error
                trials[number] = _searched(scene, fields[number], place, known.lens, turns, reach)
                advance(1)
            poses = {number: trial.pose for number, trial in trials.items()}
            known = adjusted(scene, replace(known, poses=poses, deviation=prior.deviation), PLAIN_STEPS)
    clear = [number for number, trial in trials.items() if trial.clear > _CLEAR]
    scene = scene._replace(edges_of=EDGES_OF)
    shown = shown_by(scene, known.poses, known.lens, clear)
    known = replace(known, poses=searched_by_temperature(scene, known, shown, everyone))
    return scene, adjusted(scene, known, FINE_STEPS, shown)


def searched_by_temperature(scene: Scene, known: Adjusted, shown: Shown, numbers: Sequence[int]) -> dict[int, Pose]:
    """The poses of some images by the edges that trusted ones show, which also tell their directions.

    Args:
        scene: Edges and places.
        known: All poses so far.
        shown: What trusted images show.
        numbers: The images that are searched.
    """
    pieces, poses = straight_pieces(scene.places), {}
    with progress_bar("places again", len(numbers)) as advance:
        for number in numbers:
            directions = [known.poses[one].rotation for one in _beside(number, pieces, list(shown.images))]
            poses[number] = best_pose(scene, number, known, shown.without(number), directions)
            advance(1)
    return poses


def _first_lens(scene: Scene, fields: Sequence[Field]) -> RigCamera:
    """The lens without distortion by which some images agree best with the photographs."""
    height, width = scene.images[0].slopes.shape[:2]
    asked = evenly_chosen(range(len(fields)), _ASKED)
    lenses = [RigCamera.looking_along(width, height, factor * width) for factor in FOCAL_LENGTHS]
    scores = []
    with progress_bar("focal length", len(lenses)) as advance:
        for lens in lenses:
            trials = [_searched(scene, fields[n], scene.places[n], lens, (0.0,), _FIRST_REACH) for n in asked]
            scores.append(sum(trial.score for trial in trials))
            advance(1)
    return lenses[int(np.argmax(scores))]


def _searched(scene: Scene, field: Field, place: Array, lens: RigCamera, turns: Sequence[float], reach: float) -> Trial:
    """The best pose at a place, with any of the directions of photographs near it."""
    starts: list[Pose] = []
    apart = [np.linalg.norm(pose.centre - place) for pose in scene.photographs.poses]
    for near in np.argsort(apart)[:_NEAR]:
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
