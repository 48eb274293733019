"""What is known of the places of thermal images without GPS: the best path past the photographs.

The focal length is the one whose path is best. Once some images are placed, edges of temperature tell the path of the
others far better than all edges do.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thermosplat.prepare.placing.about_placed import Prior
from thermosplat.prepare.placing.adjustment import FINE_STEPS, Adjusted, adjusted
from thermosplat.prepare.placing.lone_search import best_pose
from thermosplat.prepare.placing.photograph_places import WIDTH, asked_places, path_through, spacing
from thermosplat.prepare.placing.shift_search import Field
from thermosplat.prepare.placing.soundness import sound
from thermosplat.prepare.placing.thermal_looks import EDGES_OF_PLAIN, Scene, ThermalImage, shown_by
from thermosplat.prepare.placing.world_edges import Photographs
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.registration.edge_correlation import FOCAL_LENGTHS, edge_field
from thermosplat.prepare.registration.rig_camera import RigCamera

_ASKED = 48
"""Images one after another whose path tells the focal length. Open choice."""
_TURNS = (-4.0, 0.0, 4.0)
_OF_SPACING = 0.25
"""Standard deviation of places on a path [spacings of photographs]: on a rendered flight two in three are as near to
the truth as half a spacing."""
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
    path = path_through(photographs, fields, lens, _TURNS, edges_of=EDGES_OF_PLAIN)
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
    fields = [edge_field(image.slopes, working_width=WIDTH) for image in scene.images]
    weights = shown.without(None).weights
    path = path_through(scene.photographs, fields, known.lens, _TURNS, edges_of=scene.edges_of, weights=weights)
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
