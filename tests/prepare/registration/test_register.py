"""The thermal camera from the scene itself: where it sees true points, and what is said where it cannot be found."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from seen_room import SeenRoom, seen_room, thermal_error, write_room
from thermosplat.datasets import load_capture
from thermosplat.datasets.lens import Lens
from thermosplat.errors import UserError
from thermosplat.prepare.calibration.calibration_file import RigCalibration, write_calibration
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.registration.register import register
from thermosplat.prepare.structure.sfm import run_sfm

Room = tuple[SeenRoom, CaptureFolder]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A room whose photographs have poses."""
    made = seen_room()
    capture = write_room(made, tmp_path_factory.mktemp("room") / "capture")
    run_sfm(capture)
    return made, capture


def copied(capture: CaptureFolder, to: Path) -> CaptureFolder:
    shutil.copytree(capture.root, to)
    return CaptureFolder(to)


def with_thermal_images(capture: CaptureFolder, change: object) -> None:
    """Replace each thermal image by what a function makes of it."""
    for path in sorted(capture.images("thermal").glob("*.png")):
        cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))  # type: ignore[operator]


@pytest.mark.rotating("structure from motion")
def test_true_points_land_where_the_true_camera_sees_them(room: Room, tmp_path: Path) -> None:
    """Half a pixel in the median, though nothing was known of lens and pose; training reads the rig."""
    truth, capture = room[0], copied(room[1], tmp_path / "capture")
    said = " ".join(register(capture).sentences)
    model = pycolmap.Reconstruction(capture.sparse)
    errors = thermal_error(truth, model)
    assert np.median(errors) < 0.5
    stated = re.search(r"focal length: ([\d.]+) px, from [\d.]+% by the edges and [\d.]+% by the focal length of", said)
    lens = re.search(r"Thermal lens: focal length ([\d.]+) px", said)
    assert stated
    assert lens
    assert abs(float(lens[1]) - truth.thermal.mean_focal_length()) < 2 * float(stated[1]) < 20
    assert np.percentile(errors, 95) < 1.5
    assert sum(image.name.startswith("thermal/") for image in model.images.values()) == 12
    frames = load_capture(capture.root).train
    assert all(set(frame.views) == {"rgb", "thermal"} for frame in frames)
    views = frames[0].views
    assert abs(views["thermal"].camera.fx / truth.thermal.mean_focal_length() - 1) < 0.02
    assert not np.allclose(views["rgb"].viewmat, views["thermal"].viewmat)


@pytest.mark.slow
def test_a_thermal_camera_may_be_mounted_upside_down(tmp_path: Path, room: Room) -> None:
    """A turn by 180° about the optical axis is found like any other."""
    truth, capture = room[0], copied(room[1], tmp_path / "capture")
    with_thermal_images(capture, lambda image: np.ascontiguousarray(image[::-1, ::-1]))
    turned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ truth.thermal_from_rgb
    f, cx, cy, k1, k2 = truth.thermal.params
    lens = pycolmap.Camera(model="RADIAL", width=240, height=180, params=[f, 240 - cx, 180 - cy, k1, k2])
    register(capture)
    errors = thermal_error(
        replace(truth, thermal=lens, thermal_from_rgb=turned), pycolmap.Reconstruction(capture.sparse)
    )
    assert np.median(errors) < 0.5


@pytest.mark.slow
def test_aligned_images_are_recognised(room: Room, tmp_path: Path) -> None:
    """Both cameras at one place: thermal images are photographs but for a shift, a scale and the lens."""
    pose = room[0].thermal_from_rgb.copy()
    pose[:3, 3] = 0
    truth = replace(room[0], thermal_from_rgb=pose)
    capture, seen = copied(room[1], tmp_path / "capture"), write_room(truth, tmp_path / "seen")
    shutil.copytree(seen.images("thermal"), capture.images("thermal"), dirs_exist_ok=True)
    said = " ".join(register(capture).sentences)
    assert "aligned with the photographs except for a constant shift and scale" in said
    model = pycolmap.Reconstruction(capture.sparse)
    assert np.median(thermal_error(truth, model)) < 0.5
    (rig,) = model.rigs.values()
    (pose_found,) = rig.non_ref_sensors.values()
    assert np.abs(pose_found.translation).max() == 0


@pytest.mark.slow
def test_pairs_that_do_not_fit_are_named(room: Room, tmp_path: Path) -> None:
    """Two thermal images that are exchanged, and one of a plain wall."""
    capture = copied(room[1], tmp_path / "capture")
    thermal = capture.images("thermal")
    (thermal / "002.png").rename(thermal / "other.png")
    (thermal / "009.png").rename(thermal / "002.png")
    (thermal / "other.png").rename(thermal / "009.png")
    noise = np.random.default_rng(0).normal(29_300, 2, (180, 240))
    cv2.imwrite(str(thermal / "005.png"), noise.astype(np.uint16))
    said = " ".join(register(capture).sentences)
    assert "2 pairs fit worse than the others; look: 002.jpg, 009.jpg." in said
    assert "1 thermal image shows too few contours to tell whether it fits: 005.jpg." in said


@pytest.mark.slow
def test_mirrored_thermal_images_are_recognised(room: Room, tmp_path: Path) -> None:
    """The sentence says what to do about them."""
    capture = copied(room[1], tmp_path / "capture")
    with_thermal_images(capture, lambda image: np.ascontiguousarray(image[:, ::-1]))
    with pytest.raises(UserError, match="when they are mirrored"):
        register(capture)


@pytest.mark.slow
def test_thermal_images_of_something_else_do_not_fit(room: Room, tmp_path: Path) -> None:
    """Noise meets edges as often as chance has it: no rig is written."""
    capture = copied(room[1], tmp_path / "capture")
    generator = np.random.default_rng(0)
    with_thermal_images(capture, lambda image: generator.normal(29000, 50, image.shape).astype(np.uint16))
    with pytest.raises(UserError, match="do not fit the photographs"):
        register(capture)
    names = [image.name for image in pycolmap.Reconstruction(capture.sparse).images.values()]
    assert not any(name.startswith("thermal/") for name in names)


def test_two_sizes_of_thermal_images_are_refused(room: Room, tmp_path: Path) -> None:
    """The sentence counts them."""
    capture = copied(room[1], tmp_path / "capture")
    path = capture.images("thermal") / "003.png"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])
    with pytest.raises(UserError, match=r"11 of 240x180 px, 1 of 120x90 px"):
        register(capture)


def test_an_unreadable_thermal_image_is_named(room: Room, tmp_path: Path) -> None:
    """The file in the middle that is no picture."""
    capture = copied(room[1], tmp_path / "capture")
    (capture.images("thermal") / "005.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"005\.png is listed in pairs\.csv and cannot be read"):
        register(capture)


def test_pairs_without_poses_are_too_few(room: Room, tmp_path: Path) -> None:
    """Two pairs are left of twelve."""
    capture = copied(room[1], tmp_path / "capture")
    capture.write_pairs(capture.read_pairs()[:2])
    with pytest.raises(UserError, match=r"2 of 2 pairs of .* have a photograph with a pose"):
        register(capture)


@pytest.mark.rotating("structure from motion")
def test_a_board_gives_metres(room: Room, tmp_path: Path) -> None:
    """With the rig's calibration, distances between cameras are the true ones to 3%; again changes nothing."""
    truth, capture = room[0], copied(room[1], tmp_path / "capture")
    lenses = [Lens.from_colmap(camera) for camera in (truth.rgb, truth.thermal)]
    write_calibration(capture.calibration_json, RigCalibration(*lenses, truth.thermal_from_rgb))
    register(capture)
    model = pycolmap.Reconstruction(capture.sparse)
    photographs = sorted((i for i in model.images.values() if i.name.startswith("rgb/")), key=lambda image: image.name)
    found = np.linalg.norm(photographs[0].projection_center() - photographs[-1].projection_center())
    first, last = (np.linalg.inv(truth.viewmats[k])[:3, 3] for k in (0, -1))
    assert abs(found / np.linalg.norm(first - last) - 1) < 0.03
    assert np.median(thermal_error(truth, model)) < 0.5
    capture.marker("register").unlink()
    register(capture)
    again = pycolmap.Reconstruction(capture.sparse)
    assert sorted(i.name for i in again.images.values()) == sorted(i.name for i in model.images.values())
    np.testing.assert_allclose(thermal_error(truth, again), thermal_error(truth, model), atol=0.02)
