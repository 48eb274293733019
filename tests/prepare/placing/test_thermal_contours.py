"""Contours of temperature beside the photographs' edges."""

from dataclasses import replace

import numpy as np

from night_flight import night_flight
from thermosplat.prepare.placing.adjustment import Adjusted
from thermosplat.prepare.placing.thermal_contours import with_contours
from thermosplat.prepare.placing.thermal_looks import Scene, shown_by
from thermosplat.prepare.placing.world_edges import Photographs
from thermosplat.prepare.registration.stereo_edges import EdgePoints

NIGHT = night_flight()
POSES = dict(enumerate(NIGHT.poses))
KNOWN = Adjusted(NIGHT.lens, POSES, NIGHT.common_error, 0.3)
MIDDLE = np.array([4.0, -6.0])
"""Where the photographs show no edges here [m]."""


def scene_without_edges_about_the_middle() -> Scene:
    edges = NIGHT.photographs.edges
    kept = (np.abs(edges.points[:, :2] - MIDDLE) > 3).any(1)
    bare = EdgePoints(edges.frame[kept], edges.points[kept], edges.along[kept])
    return Scene(replace(NIGHT.photographs, edges=bare), NIGHT.images, NIGHT.gps, 0.05, 4)


def contours_about_the_middle(photographs: Photographs) -> np.ndarray:
    edges = photographs.edges
    ours = edges.frame >= len(photographs.poses)
    return edges.points[ours & (np.abs(edges.points[:, :2] - MIDDLE) < 3).all(1)]


def test_contours_lie_on_the_surfaces() -> None:
    """Warm outlines that no photograph shows are found by several images, on the ground or the roof that they are on.

    Steps of 5 m are too high for one surface: nothing lies between.
    """
    scene = with_contours(scene_without_edges_about_the_middle(), KNOWN, list(POSES))
    found = contours_about_the_middle(scene.photographs)
    assert len(found) > 100
    heights = np.minimum(np.abs(found[:, 2]), np.abs(found[:, 2] - 5))
    assert np.percentile(heights, 90) < 0.5
    truth = NIGHT.photographs.edges.points[NIGHT.warm]
    apart = [np.linalg.norm(truth[:, :2] - point[:2], axis=1).min() for point in found]
    assert np.median(apart) < 0.3


def test_they_are_edges_to_all_images_but_their_own() -> None:
    """Others show them, too; an image by itself tells nothing of where it is."""
    scene = with_contours(scene_without_edges_about_the_middle(), KNOWN, list(POSES))
    shown = shown_by(scene, POSES, NIGHT.lens, POSES)
    for number, own in scene.photographs.of_placed().items():
        assert not shown.without(number).seen[own].any()
        assert not shown.without(number).weights[own].any()
    of_others = shown_by(scene, POSES, NIGHT.lens, [2, 3])
    assert not of_others.without(5).seen[scene.photographs.of_placed()[5]].any()
    together = shown.without(None)
    contours = scene.photographs.edges.frame >= len(scene.photographs.poses)
    assert together.weights[contours & (together.seen > 2)].mean() > 0.6


def test_they_are_made_anew() -> None:
    """Of the images that are placed now, beside the photographs' edges as they were."""
    plain = scene_without_edges_about_the_middle()
    once = with_contours(plain, KNOWN, [2, 3, 5])
    again = with_contours(with_contours(plain, KNOWN, list(POSES)), KNOWN, [2, 3, 5])
    np.testing.assert_array_equal(once.photographs.edges.points, again.photographs.edges.points)
    assert list(again.photographs.placed) == [2, 3, 5]
    near = again.photographs.near(POSES[3], 2)
    count = len(plain.photographs.poses)
    assert [number < count for number in near] == [True, True, False, False]
    assert near[2] == count + 1


def test_nothing_about_an_image_without_edges() -> None:
    """Where photographs show no edge, nothing tells how deep a contour lies."""
    plain = scene_without_edges_about_the_middle()
    edges = plain.photographs.edges
    none = replace(plain.photographs, edges=EdgePoints(edges.frame[:0], edges.points[:0], edges.along[:0]))
    assert not len(with_contours(plain._replace(photographs=none), KNOWN, [2, 3]).photographs.edges.points)
