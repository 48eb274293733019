"""Thermal images about placed without GPS: each near a photograph.

1. The best path past the photographs says about where each image was taken, and the focal length is the one whose path
   is best (``photograph_places``).
2. Each image is searched at places around, farther and then nearer, and all are adjusted together.
3. Sound images tell which edges are edges of temperature. By these the others are searched past all photographs again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from thermosplat.prepare.placing.adjustment import FINE_STEPS, PLAIN_STEPS, Adjusted, adjusted
from thermosplat.prepare.placing.lone_search import best_pose
from thermosplat.prepare.placing.photograph_places import WIDTH, path_through, spacing
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, Field, best_trial
from thermosplat.prepare.placing.soundness import sound
from thermosplat.prepare.placing.thermal_looks import EDGES_OF, EDGES_OF_PLAIN, Scene, ThermalImage, shown_by
from thermosplat.prepare.placing.world_edges import Photographs, Pose
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, edge_field
from thermosplat.prepare.registration.rig_camera import Array, RigCamera

_ASKED = 48
"""Images one after another whose path tells the focal length. Open choice."""
_TURNS, _NEAR_TURNS = (-4.0, 0.0, 4.0), (-2.0, 0.0, 2.0)
_ASIDE = ((0.5, 0.25), (0.25, 0.125))
"""Distances [spacings of photographs] of the places around that are tried, of each round by all edges."""
_REACH = 0.12
"""Largest shift [image widths] from a place beside."""
_AROUND = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
_BY_TEMPERATURE = (0.25, 0.125)
"""Standard deviation [spacings of photographs] of places on the path, of each round by edges of temperature."""


def placed_by_paths(photographs: Photographs, images: Sequence[ThermalImage]) -> tuple[Scene, Adjusted]:
    """Images about where they were taken.

    Args:
        photographs: The photographs.
        images: The thermal images, in the order in which they were taken.
    """
    coarse, fields = (
        [edge_field(one.slopes, working_width=width) for one in images] for width in (WIDTH, SEARCH_WIDTH)
    )
    unit = spacing(photographs.poses)
    lens = _first_lens(photographs, images, coarse)
    path = path_through(photographs, coarse, lens, _TURNS, edges_of=EDGES_OF_PLAIN)
    scene = Scene(photographs, images, _places(dict(enumerate(path.poses))), _ASIDE[-1][-1] * unit, EDGES_OF_PLAIN)
    known = Adjusted(lens, dict(enumerate(path.poses)), np.zeros(3), unit)
    for distances in _ASIDE:
        poses = known.poses
        for distance in distances:
            poses = {n: _beside(photographs, fields[n], poses[n], known.lens, distance * unit) for n in poses}
        scene = scene._replace(places=_places(poses))
        known = replace(known, poses=poses, common_error=np.zeros(3), deviation=distances[-1] * unit)
        known = adjusted(scene, known, PLAIN_STEPS)
    scene = scene._replace(edges_of=EDGES_OF)
    for deviation in _BY_TEMPERATURE:
        right, _ = sound(scene, known)
        shown = shown_by(scene, known.poses, known.lens, right)
        weights = shown.without(None).weights
        path = path_through(photographs, coarse, known.lens, _TURNS, edges_of=EDGES_OF, weights=weights)
        poses = {**dict(enumerate(path.poses)), **{n: known.poses[n] for n in right}}
        scene = scene._replace(places=_places(poses))
        known = replace(known, poses=poses, common_error=np.zeros(3), deviation=deviation * unit)
        poses = {n: best_pose(scene, n, fields[n], known, shown.without(n), [poses[n].rotation]) for n in poses}
        known = adjusted(scene, replace(known, poses=poses), FINE_STEPS, shown)
    return scene, known


def _first_lens(photographs: Photographs, images: Sequence[ThermalImage], fields: Sequence[Field]) -> RigCamera:
    """The lens without distortion with the best path: every second one, as edges agree at 7% beside, too."""
    height, width = images[0].slopes.shape[:2]
    first = max(0, len(fields) - _ASKED) // 2
    lenses = [RigCamera.looking_along(width, height, factor * width) for factor in FOCAL_LENGTHS[::2]]
    scores = []
    with progress_bar("focal length", len(lenses)) as advance:
        for lens in lenses:
            asked = fields[first : first + _ASKED]
            scores.append(path_through(photographs, asked, lens, (0.0,), edges_of=EDGES_OF_PLAIN).score)
            advance(1)
    return lenses[int(np.argmax(scores))]


def _beside(photographs: Photographs, field: Field, pose: Pose, lens: RigCamera, distance: float) -> Pose:
    """The best pose at places around, twice."""
    for _ in range(2):
        starts = [Pose(pose.rotation, place) for place in pose.centre + distance * _AROUND]
        pose = best_trial(field, photographs, starts, lens, _NEAR_TURNS, edges_of=EDGES_OF_PLAIN, reach=_REACH).pose
    return pose


def _places(poses: Mapping[int, Pose]) -> Array:
    return np.array([poses[number].centre for number in range(len(poses))])
