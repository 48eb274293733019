"""Thermal images of another hour: where true points land, and what is told apart."""

from collections.abc import Collection
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from flown_model import flight
from night_flight import NightFlight, night_flight
from thermosplat.prepare.placing.adjustment import Adjusted, adjusted, aligned
from thermosplat.prepare.placing.placed_images import placed_images
from thermosplat.prepare.placing.shift_search import SEARCH_WIDTH, best_trial
from thermosplat.prepare.placing.thermal_looks import Expected, Scene, ThermalImage, edges_shown, likeness, shown_by
from thermosplat.prepare.placing.world_edges import Pose
from thermosplat.prepare.registration.edge_correlation import QUARTERS, edge_field, turn_about_axis
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import with_unpaired


@pytest.fixture(scope="module")
def night() -> NightFlight:
    return night_flight()


def scene_of(night: NightFlight) -> Scene:
    return Scene(night.photographs, night.images, night.gps, 0.05, 4)


@pytest.mark.parametrize("number", [2, 10])
def test_one_image_is_found_from_a_photograph_near_it(night: NightFlight, number: int) -> None:
    """Whichever way the drone flew, within the cells of the search."""
    place = night.gps[number] - night.common_error
    starts = [Pose(turn_about_axis(angle) @ night.photographs.poses[0].rotation, place) for angle in QUARTERS]
    field = edge_field(night.images[number].slopes, working_width=SEARCH_WIDTH)
    trial = best_trial(field, night.photographs, starts, night.lens, (-3.0, 0.0, 3.0), edges_of=4, reach=0.15)
    assert night.error(number, trial.pose, night.lens) < 6
    assert trial.clear > 1.1


def test_poses_lens_and_the_error_of_gps_are_adjusted_together(night: NightFlight) -> None:
    """From poses that are off by half a degree and a lens that is 5% too long; over roofs of 5 m a longer lens from
    farther away looks nearly the same."""
    generator = np.random.default_rng(1)
    poses = {
        number: Pose(cv2.Rodrigues(generator.normal(0, 0.008, 3))[0] @ pose.rotation, night.gps[number])
        for number, pose in enumerate(night.poses)
    }
    lens = replace(night.lens, lens=night.lens.lens * [1.05, 1, 1, 1, 1])
    steps = [*[(("log_f",), (8.0, 3.0, None))] * 4, *[(("log_f", "k1"), (3.0, 1.0, None))] * 6]
    found = adjusted(scene_of(night), Adjusted(lens, poses, np.zeros(3), 0.5), steps)
    errors = [night.error(number, pose, found.lens) for number, pose in found.poses.items()]
    assert np.median(errors) < 0.7
    assert abs(found.lens.lens[0] - 280) < 10
    assert np.linalg.norm((found.common_error - night.common_error)[:2]) < 0.6


def expected_of(night: NightFlight, number: int, trusted: Collection[int] | None = None) -> Expected:
    """What an image should show by some others at their true poses."""
    poses = dict(enumerate(night.poses))
    return shown_by(scene_of(night), poses, night.lens, poses if trusted is None else trusted).without(number)


def test_images_tell_which_edges_are_warm(night: NightFlight) -> None:
    """Paint counts little, roofs much; an image elsewhere shows little of what the others show, and looks unlike it."""
    expected = expected_of(night, 3)
    seen = expected.seen > 2
    assert expected.weights[seen & night.warm].mean() > 2 * expected.weights[seen & ~night.warm].mean()
    true = night.poses[3]
    right, elsewhere = (replace(true, centre=true.centre + shift) for shift in (np.zeros(3), np.array([2.0, 1.0, 0.0])))
    of_right, of_elsewhere = (
        (
            *edges_shown(scene_of(night), 3, pose, night.lens, expected.weights),
            likeness(scene_of(night), 3, pose, night.lens, expected),
        )
        for pose in (right, elsewhere)
    )
    assert of_right[0] > 0.5 > 0.3 > of_elsewhere[0]
    assert of_right[1] > 2 * of_elsewhere[1]
    assert of_right[2] > 0.6 > 0.3 > of_elsewhere[2]
    alone = expected_of(night, 3, [3])
    assert not alone.weights.any()
    assert not alone.seen.any()


def test_looks_draw_an_image_to_the_others(night: NightFlight) -> None:
    """Where no edge counts: from four pixels aside to less than one. Edges alone leave it where it was."""
    expected = replace(expected_of(night, 3), weights=np.zeros(len(night.warm)))
    start = Pose(cv2.Rodrigues(np.array([0.012, -0.008, 0.01]))[0] @ night.poses[3].rotation, night.poses[3].centre)
    known = Adjusted(night.lens, {3: start}, night.common_error, 0.3)
    windows = [(2.0, 1.0, scale) for scale in (0, 0, 0, 0, 0, 0, 1, 1, 1, 1)]
    found = aligned(scene_of(night), 3, start, known, windows, expected)
    alone = aligned(scene_of(night), 3, start, known, [(2.0, 1.0, None)] * 10, expected)
    assert night.error(3, start, night.lens) > 3
    assert night.error(3, found, night.lens) < 1
    assert night.error(3, alone, night.lens) > 3


@pytest.mark.slow
@pytest.mark.parametrize("by_gps", [True, False])
def test_images_find_their_places(night: NightFlight, by_gps: bool) -> None:
    """By GPS or by a path: nearly all within two pixels, none wrong, and an image of noise is left out."""
    noise = ThermalImage.of(np.random.default_rng(0).normal(0, 0.1, night.images[5].slopes.shape[:2]))
    images = [noise if number == 5 else image for number, image in enumerate(night.images)]
    found = placed_images(night.photographs, images, night.gps if by_gps else None)
    errors = {number: night.error(number, found.known.poses[number], found.known.lens) for number in found.right}
    assert 5 not in errors
    assert sum(error < 2 for error in errors.values()) >= 11
    assert max(errors.values()) < 6


def test_a_model_with_images_of_other_moments() -> None:
    """They are exposures of their own, with one camera; doing it again replaces them."""
    lens = RigCamera.looking_along(320, 240, 400.0)
    pose = pycolmap.Rigid3d(np.column_stack([np.eye(3), [1.0, 2.0, 3.0]]))
    model = with_unpaired(flight(points=40).model, lens, {"a.png": pose, "b.png": pose})
    again = with_unpaired(model, lens, {"b.png": pose})
    thermal = [image for image in again.images.values() if image.name.startswith("thermal/")]
    assert [image.name for image in thermal] == ["thermal/b.png"]
    assert np.allclose(thermal[0].cam_from_world().translation, [1, 2, 3])
    assert (len(model.images), len(again.images), len(again.cameras)) == (42, 41, 2)
    assert again.num_points3D() == model.num_points3D()
