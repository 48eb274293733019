"""Scenes that lie far from the origin of their world, or are too small or too large for it."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from capture_folders import write_transforms
from moved_captures import UTM, WORLDS, pixels, write_moved
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.placement import USUAL_REACH, WORLD, Placement

CENTERS = np.random.default_rng(0).normal(size=(20, 3))
POINTS = np.random.default_rng(1).normal(size=(50, 3))


def placed(scale: float = 1.0, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Placement:
    return Placement.of(scale * CENTERS + offset, scale * POINTS + offset)


@pytest.mark.parametrize("scale", [0.3, 1.0, 300.0, 1e5])
def test_usual_coordinates_stay(scale: float) -> None:
    """From a nerfstudio capture in a box of 1 to a flight in metres or millimetres, some sizes from the origin."""
    for shift in (0.0, 5.0):
        assert placed(scale, (shift * scale, 0.0, 0.0)) == WORLD


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 0.01, 1e8])
def test_other_sizes_become_usual_ones(scale: float) -> None:
    """By a power of two, so that numbers keep their digits: what is nearest to cameras lies at about 1."""
    unit = placed(scale).unit
    assert np.log2(unit) == round(np.log2(unit))
    nearest = np.median([np.sort(np.linalg.norm(POINTS - center, axis=1))[9] for center in CENTERS])
    assert 0.7 < scale * nearest / unit / USUAL_REACH < 1.43


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_a_street_keeps_what_is_near(unit: float) -> None:
    """Five kilometres of it, whose houses are 3 to 10 m away: in no unit does the near plane reach them."""
    rng = np.random.default_rng(0)
    along = np.sort(rng.uniform(0, 5000, 400))
    centers = np.stack([along, rng.normal(size=400), np.full(400, 2.0)], axis=1)
    houses = np.stack([rng.uniform(0, 5000, 40_000), *rng.uniform(3, 10, (2, 40_000))], axis=1)
    placement = Placement.of(unit * centers, unit * houses)
    assert unit * 3.0 / placement.unit > 0.1


@pytest.mark.parametrize(
    ("scale", "offset", "origin"),
    [
        (0.7, UTM, UTM),
        (100.0, (500_012.3, 4_600_078.9, 310.0), (500_000.0, 4_600_100.0, 300.0)),
        (1e-3, (1.23456, 0.0, 0.0), (1.235, 0.0, 0.0)),
    ],
)
def test_a_far_scene_has_an_origin_of_few_digits(scale: float, offset, origin) -> None:
    """People and programs subtract it."""
    found = placed(scale, offset)
    assert found.is_moved
    np.testing.assert_allclose(found.origin, origin, atol=1.01 * 10 ** np.floor(np.log10(2 * scale)))
    assert all(float(f"{coordinate:.8g}") == coordinate for coordinate in found.origin)


def test_outliers_and_missing_points_do_not_decide() -> None:
    """The middle counts; cameras in one place without any point have no size."""
    assert Placement.of(np.vstack([CENTERS, [[1e9, 0, 0]]]), np.vstack([POINTS, [[1e300, 0, 0], [np.nan, 0, 0]]])) == (
        WORLD
    )
    assert Placement.of(np.zeros((3, 3)), np.zeros((0, 3))) == WORLD
    on_cameras = np.vstack([np.repeat(CENTERS, 12, axis=0), 5.0 + POINTS])
    assert Placement.of(CENTERS, on_cameras).unit * 1e6 > 0.5
    assert Placement.of(CENTERS + 1e6, np.zeros((0, 3))).is_moved


def test_there_and_back() -> None:
    """Points, poses and a checkpoint's state, at UTM coordinates to a nanometre."""
    placement = placed(5e-3, UTM)
    world = 0.1 * POINTS + UTM
    np.testing.assert_allclose(placement.to_world(placement.to_scene(world)), world, rtol=0, atol=2e-9)
    turn = np.linalg.qr(CENTERS[:3])[0]
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ UTM + (0.1, 0.2, 0.3)
    in_scene = placement.viewmat_to_scene(viewmat)
    np.testing.assert_allclose(placement.viewmat_to_world(in_scene), viewmat, rtol=0, atol=2e-9)
    both = ((world, viewmat), (placement.to_scene(world), in_scene))
    seen, same = (points @ pose[:3, :3].T + pose[:3, 3] for points, pose in both)
    np.testing.assert_allclose(placement.unit * same, seen, rtol=0, atol=4e-9)
    assert Placement.from_state(placement.state()) == placement
    assert Placement.from_state({}) == WORLD
    with pytest.raises(ValueError, match="the unit 0"):
        Placement.from_state({"unit": 0})


def seen_points(capture: Capture) -> NDArray[np.float64]:
    """Where the sparse points lie in every view [px], in the order of frames and spectra."""
    views = [view for frame in (*capture.train, *capture.test) for view in frame.views.values()]
    return np.stack([pixels(view.viewmat, view.camera.K, capture.points) for view in views])


@pytest.mark.parametrize("world", WORLDS)
def test_a_capture_of_any_world_sees_the_same(world: str, tmp_path: Path) -> None:
    """Read from text and binary: points lie where they lay in the images, and come back where they were."""
    usual = load_capture(write_moved(tmp_path / "usual", WORLD))
    assert usual.placement == WORLD
    assert not any("Inside" in note for note in usual.notes)
    for binary in (True, False):
        capture = load_capture(write_moved(tmp_path / f"{binary}", WORLDS[world], binary=binary))
        np.testing.assert_allclose(seen_points(capture), seen_points(usual), atol=1e-3)
        expected = WORLDS[world].to_world(usual.points)
        atol = 1e-6 * WORLDS[world].unit
        np.testing.assert_allclose(capture.placement.to_world(capture.points), expected, rtol=0, atol=atol)
        assert sum("Inside" in note for note in capture.notes) == (capture.placement != WORLD)


def test_a_capture_is_placed_as_another_scene_is(tmp_path: Path) -> None:
    """As a checkpoint without a frame of its own needs it; its own frame changes nothing."""
    capture = load_capture(write_moved(tmp_path, WORLDS["UTM, in kilometres"]))
    assert capture.placed(capture.placement) is capture
    world = capture.placed(WORLD)
    view, other = capture.train[0].views["rgb"], world.train[0].views["rgb"]
    np.testing.assert_array_equal(other.viewmat, capture.placement.viewmat_to_world(view.viewmat))
    np.testing.assert_allclose(world.points, capture.placement.to_world(capture.points), rtol=1e-7)
    back = world.placed(capture.placement)
    np.testing.assert_allclose(back.train[0].views["rgb"].viewmat, view.viewmat, atol=1e-9)


def test_rounded_rotations_far_from_the_origin(tmp_path: Path) -> None:
    """Poses of six digits, as many writers have them, at UTM: the cameras lie where the file says."""
    content = write_transforms(tmp_path / "far")
    rng = np.random.default_rng(0)
    for number, frame in enumerate(content["frames"]):
        pose = np.eye(4)
        pose[:3, :3] = np.round(np.linalg.qr(rng.normal(size=(3, 3)))[0], 6)
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = np.array([number, 0.5, 2.0]) + UTM
        frame["transform_matrix"] = pose.tolist()
    (tmp_path / "far" / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path / "far")
    for frame in (*capture.train, *capture.test):
        number = int(frame.name[-5:])
        center = np.linalg.inv(frame.views["rgb"].viewmat)[:3, 3]
        np.testing.assert_allclose(capture.placement.to_world(center) - UTM, [number, 0.5, 2.0], atol=1e-6)
    radius = np.linalg.norm(capture.points - capture.placement.to_scene(np.array([3.5, 0.5, 2.0]) + UTM), axis=1)
    assert 5 < np.median(radius) < 20  # random points around the cameras


@pytest.mark.parametrize("world", ["a thousandth", "UTM, in kilometres"])
@pytest.mark.parametrize("stated", [True, False])
def test_readouts_of_any_world(world: str, stated: bool, tmp_path: Path) -> None:
    """A rolling shutter bends images alike, whether its poses are stated in the world or found from the frames'."""
    motions = []
    for name, where in (("usual", WORLD), ("moved", WORLDS[world])):
        root = write_moved(tmp_path / name, where)
        content: dict = {"readout": 0.1, "interval": 1.0}
        if stated:
            poses = {}
            whole = load_capture(root)
            for frame in (*whole.train, *whole.test):
                first = whole.placement.viewmat_to_world(frame.views["rgb"].viewmat)
                last = first.copy()
                last[:3, 3] += 0.01 * where.unit
                poses[frame.views["rgb"].path.name] = [first.tolist(), last.tolist()]
            content = {"poses": poses}
        (root / "shutter.json").write_text(json.dumps({"rgb": content}))
        capture = load_capture(root)
        readouts = [frame.views["rgb"].readout for frame in (*capture.train, *capture.test)]
        motions.append([one.scaled(capture.placement.unit / where.unit).motion for one in readouts if one is not None])
        (note,) = (note for note in capture.notes if "line by line" in note)
        moved = float(note.split("moves by ")[1].split()[0])
        assert moved == pytest.approx(where.unit * np.median([np.linalg.norm(m[1, :3, 3] - m[0, :3, 3])
                                                               for m in motions[-1]]), rel=0.06)  # fmt: skip
    assert len(motions[0]) == 8
    np.testing.assert_allclose(motions[1], motions[0], atol=1e-6)
