"""Places of thermal images of another hour in the photographs' scene.

The method is that of edges which do not depend on the spectrum, searched and adjusted from coarse to fine, and then of
what thermal images show alike:

1. GPS says about where each image was taken. Without GPS a path past the photographs does (``photograph_places``).
2. Each image is searched alone from there, with the directions of photographs near it and quarter turns of them. The
   focal length is the one by which some images agree best. All poses, the lens and the common error of the places are
   adjusted together, and images are searched again.
3. Placed images tell which edges of photographs are edges of temperature (``thermal_looks``). With these alone each
   image is searched again, from several places around, and the best is kept. Without GPS, images that are not placed
   take a better path then, past edges of temperature.
4. An image counts as placed if it shows what the others show there, about as well as most do, and if it lies where it
   should. It shows edges and a look. Nothing was drawn to looks so far, so that wrong images with many edges look
   unlike the others.
5. The placed ones are adjusted together by edges and looks, and judged again. Contours of their own are edges now,
   too (``thermal_contours``).
6. What is not placed is searched again by what the placed ones show, without GPS near all photographs. All are adjusted
   and judged again, in rounds: images of one flight line hold each other, so that a line that is wrong together moves
   slowly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from thermosplat.prepare.placing.about_placed import Prior, about_placed, searched_by_temperature
from thermosplat.prepare.placing.adjustment import ALL, Adjusted, Step, adjusted
from thermosplat.prepare.placing.by_paths import on_the_path, placed_again, prior_on_path, searched_anywhere
from thermosplat.prepare.placing.soundness import sound
from thermosplat.prepare.placing.thermal_contours import with_contours
from thermosplat.prepare.placing.thermal_looks import Scene, ThermalImage, shown_by
from thermosplat.prepare.placing.world_edges import Photographs
from thermosplat.prepare.registration.rig_camera import Array

_DEVIATION, _LEAST_DEVIATION = 0.5, 0.05
"""Standard deviation [m] of GPS from image to image to begin with, and at least. Open choice."""
_AGAIN = (False, False, True)
"""Rounds on paths past edges of temperature, and whether they search images that are placed, too."""
_ROUNDS_BY_LOOKS = 3
"""Rounds of step 6. After two, two images of flight_b's 82 on flight_a's photographs were 2.7 px off; open choice."""
_LOOK_STEPS: list[list[Step]] = [
    [(ALL, window)] * 3 for window in ((3.0, 1.25, 0), (2.0, 0.75, 1), (2.0, 0.75, 1), (1.5, 0.5, 1))
]


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


def placed_images(photographs: Photographs, images: Sequence[ThermalImage], gps: Array | None = None) -> Placement:
    """Place thermal images.

    Args:
        photographs: The photographs.
        images: The thermal images, in the order in which they were taken.
        gps: Where GPS has each in the world, [N, 3]; None: they lie on a path past the photographs.
    """
    if gps is not None:
        scene, known = about_placed(photographs, images, Prior(gps, _DEVIATION, _LEAST_DEVIATION))
    else:
        scene, known = about_placed(photographs, images, prior_on_path(photographs, images))
        for everyone in _AGAIN:
            scene, known = placed_again(scene, known, everyone)
    plain, by_path = scene, gps is None
    scene, placed = _by_looks(scene, known, by_path)
    for _ in range(_ROUNDS_BY_LOOKS):
        if not placed.right:
            break
        poses = {**known.poses, **placed.known.poses}
        missing = [number for number in poses if number not in placed.right]
        shown = shown_by(scene, poses, placed.known.lens, placed.right)
        known = replace(placed.known, poses=poses)
        search = searched_anywhere if by_path else searched_by_temperature
        found = search(scene, known, shown, missing)
        known = replace(known, poses=poses | found)
        if by_path:  # an image that was elsewhere should lie where it was found
            places = scene.places.copy()
            for number, pose in found.items():
                places[number] = pose.centre + known.common_error
            scene = scene._replace(places=places)
        scene, placed = _by_looks(scene, known, by_path)
    # by the photographs' edges alone: images that are wrong together agree about contours of their own
    return replace(placed, share=sound(plain, placed.known)[1]) if placed.right else placed


def _by_looks(scene: Scene, known: Adjusted, by_path: bool) -> tuple[Scene, Placement]:
    """Images that are about placed by edges, adjusted by what they show alike; and the scene with their contours."""
    right, share = _placed(scene, known, by_path)
    if not right:
        return scene, Placement(known, right, share)
    known = replace(known, poses={number: known.poses[number] for number in right})
    for steps in _LOOK_STEPS:  # each image moves towards the others, and these move, too
        scene = with_contours(scene, known, right)
        known = adjusted(scene, known, steps, shown_by(scene, known.poses, known.lens, right))
    scene = with_contours(scene, known, right)
    right, share = _placed(scene, known, by_path)
    return scene, Placement(known, right, share)


def _placed(scene: Scene, known: Adjusted, by_path: bool) -> tuple[list[int], float]:
    """As ``sound``; without GPS images lie on their path, too."""
    right, share = sound(scene, known)
    return (on_the_path(known.poses, right) if by_path else right), share
