"""The pose of one image at a time: the best of many starts by the edges that others show, where it should lie."""

from collections.abc import Sequence

import numpy as np

from thermosplat.prepare.placing.adjustment import Adjusted, Window, aligned
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, Trial, best_trial
from thermosplat.prepare.placing.thermal_looks import Expected, Scene, edges_shown
from thermosplat.prepare.placing.world_edges import Pose
from thermosplat.prepare.registration.edge_correlation import edge_field
from thermosplat.prepare.registration.rig_camera import Array

REACH, _LAST_REACH = 0.14, 0.09
"""Largest shifts [image widths]: GPS that is wrong by decimetres, and a place that is tried beside another."""
TURNS, _LAST_TURNS = (-4.0, -2.0, 0.0, 2.0, 4.0), (-1.5, 0.0, 1.5)
_STARTS = 1.5 * np.concatenate([np.eye(3), -np.eye(3)])
"""Places around one from which an image is searched [standard deviations of its place]."""
_NOT_TURNED = 1 + 2 * np.cos(np.radians(25.0))
"""Trace of the largest turn of an image's last pose against the direction that is expected."""
ALONE: list[Window] = [*[(5.0, 2.0, None)] * 3, *[(3.0, 1.25, None)] * 3, *[(2.0, 0.75, None)] * 2]
"""Windows of the adjustment of one image."""


def best_pose(scene: Scene, number: int, known: Adjusted, expected: Expected, directions: Sequence[Array]) -> Pose:
    """The pose of one image that shows best the edges that others show, and lies where it should.

    Both are judged in standard deviations: edges by their number, places by half their square, as likelihoods are.

    Args:
        scene: Edges and places.
        number: The image.
        known: The lens, poses so far, and what is known of places.
        expected: What the image should show.
        directions: World to camera, about as the image may look.
    """
    place, now = scene.places[number] - known.common_error, known.poses[number]
    field = edge_field(scene.images[number].slopes, working_width=SEARCH_WIDTH)

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
        ended = [aligned(scene, number, pose, known, ALONE, expected) for pose in poses]
        off = [float(np.linalg.norm(pose.centre - place)) / known.deviation for pose in ended]
        shows = [edges_shown(scene, number, pose, known.lens, expected.weights)[1] for pose in ended]
        return max(zip(np.subtract(shows, np.square(off) / 2), ended), key=lambda one: one[0])

    trials = [search(Pose(direction, place), TURNS, REACH) for direction in directions]
    most, best = best_of([pose for trial in trials for pose in (trial.pose, trial.other)])
    if np.trace(now.rotation @ best.rotation.T) > _NOT_TURNED:
        most, best = max((most, best), best_of([now]), key=lambda one: one[0])
    for middle in (place, best.centre):
        around = [Pose(best.rotation, start) for start in middle + known.deviation * _STARTS]
        ended = best_of([search(start, _LAST_TURNS, _LAST_REACH).pose for start in around])
        most, best = max((most, best), ended, key=lambda one: one[0])
    return best
