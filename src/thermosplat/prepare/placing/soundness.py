"""Which images are placed: those that show what the others show there, and lie where they should."""

import numpy as np

from thermosplat.prepare.placing.adjustment import Adjusted
from thermosplat.prepare.placing.thermal_looks import Scene, edges_shown, likeness, shown_by

_OF_USUAL, _OFF = 0.46, 5.0
"""Share of what is usual that edges times looks are at least, and standard deviations from where an image should lie at
most, for it to be placed. Chosen on rendered flights."""


def sound(scene: Scene, known: Adjusted) -> tuple[list[int], float]:
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
    off = np.array([np.linalg.norm(scene.places[n] - known.common_error - pose.centre) for n, pose in poses.items()])
    right = shows & (off < _OFF * known.deviation)
    return [number for number, is_right in zip(poses, right) if is_right], share
