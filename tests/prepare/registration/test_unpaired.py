"""Thermal images of another hour: where true points land, and which images are left out."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from flown_model import flight
from seen_room import SeenRoom, seen_room, write_room
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.registration.edge_alignment import Meeting
from thermosplat.prepare.registration.register import register
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import with_unpaired
from thermosplat.prepare.registration.unpaired import Place, _pieces, _solved, _sound
from thermosplat.prepare.structure.sfm import run_sfm


def place(centre: list[float], near: int = 600, by_chance: float = 300.0) -> Place:
    return Place(np.eye(3), np.array(centre, float), Meeting(2000, near, by_chance))


def test_straight_pieces_of_a_path() -> None:
    """A turn, a missing position and the largest number end a piece; every image is in one."""
    east = [np.array([4.0 * i, 0.0, 30.0]) for i in range(5)]
    north = [np.array([16.0, 4.0 * i, 30.0]) for i in range(1, 4)]
    assert _pieces([*east, *north, None, np.zeros(3)]) == [[0, 1, 2, 3, 4], [5, 6, 7], [8], [9]]
    assert [len(piece) for piece in _pieces([np.array([4.0 * i, 0.0, 30.0]) for i in range(14)])] == [6, 6, 2]
    assert _pieces([None, None]) == [[0], [1]]
    assert _pieces([np.zeros(3), np.zeros(3)]) == [[0], [1]]


def test_images_that_lie_elsewhere_than_gps_says_are_left_out() -> None:
    """A common error of all is none; so is an image whose edges meet far less than the others'."""
    gps: list[np.ndarray | None] = [np.array([4.0 * i, 0.1 * (i % 3), 30.0]) for i in range(8)]
    places = {i: place([4.0 * i - 1.3, 0.5, 26.0]) for i in range(8)}
    assert set(_sound(places, gps)) == set(range(8))
    places[3] = place([4.0 * 3 + 6.0, 0.5, 26.0])
    places[5] = place([4.0 * 5 - 1.3, 0.5, 26.0], near=410)
    assert set(_sound(places, gps)) == {0, 1, 2, 4, 6, 7}
    assert _sound({}, gps) == {}


def test_poses_and_the_lens_are_solved_together() -> None:
    """The step is that of all unknowns at once."""
    generator = np.random.default_rng(0)
    frame = np.repeat(np.arange(3), 400)
    rows, truth = generator.normal(size=(1200, 11)), generator.normal(size=(3, 6))
    lens = 0.01 * generator.normal(size=5)
    offsets = np.einsum("ni,ni->n", rows[:, :6], truth[frame]) + rows[:, 6:] @ lens
    steps, found = _solved(frame, rows, offsets, np.ones(1200), 3, 320)
    assert np.allclose(steps, truth, atol=1e-3)
    assert np.allclose(found, lens, atol=1e-3)


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


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[SeenRoom, CaptureFolder]:
    """A room whose photographs have poses, and whose thermal images have no partners."""
    made = seen_room()
    capture = write_room(made, tmp_path_factory.mktemp("room") / "capture")
    run_sfm(capture)
    capture.write_pairs([])
    return made, capture


def _errors(truth: SeenRoom, model: pycolmap.Reconstruction) -> dict[str, float]:
    """How far true points land from where each thermal image sees them [px], in the median."""
    photographs = sorted((i for i in model.images.values() if i.name.startswith("rgb/")), key=lambda image: image.name)
    found = np.array([image.projection_center() for image in photographs])
    true = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in truth.viewmats])
    similarity = pycolmap.estimate_sim3d_robust(true, found, pycolmap.RANSACOptions(max_error=0.05))
    to_model = (similarity["tgt_from_src"] if isinstance(similarity, dict) else similarity).matrix()
    w, h = truth.thermal.width, truth.thermal.height
    grid = np.stack(np.meshgrid(np.linspace(15, w - 15, 12), np.linspace(15, h - 15, 9)), -1).reshape(-1, 2)
    errors = {}
    for image in model.images.values():
        if image.name.startswith("thermal/"):
            pose = truth.thermal_from_rgb @ truth.viewmats[int(Path(image.name).stem)]
            rays = np.column_stack([truth.thermal.cam_from_img(grid), np.ones(len(grid))]) * 3.0
            world = (rays - pose[:3, 3]) @ pose[:3, :3]
            local = (world @ to_model[:, :3].T + to_model[:, 3]) @ image.cam_from_world().matrix()[:, :3].T
            local += image.cam_from_world().translation
            seen = model.cameras[image.camera_id].img_from_cam(local)
            errors[image.name] = float(np.median(np.linalg.norm(seen - grid, axis=1)))
    return errors


@pytest.mark.slow
def test_images_find_their_own_places(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """Without partners and positions: nearly all within two pixels, none placed wrongly; one of noise is named."""
    truth, capture = room[0], CaptureFolder(tmp_path / "capture")
    shutil.copytree(room[1].root, capture.root)
    noise = np.random.default_rng(0).normal(29_500, 60, (180, 240)).astype(np.uint16)
    cv2.imwrite(str(capture.images("thermal") / "004.png"), noise)
    said = " ".join(register(capture).sentences)
    errors = _errors(truth, pycolmap.Reconstruction(capture.sparse))
    assert sum(error < 2.0 for error in errors.values()) >= 10
    assert max(errors.values()) < 6.0
    assert "thermal/004.png" not in errors
    assert "004.png" in said
    frames = load_capture(capture.root).train
    assert any("thermal" in frame.views for frame in frames)


@pytest.mark.slow
def test_images_of_another_place(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """None is placed, and that is said."""
    capture = CaptureFolder(tmp_path / "capture")
    shutil.copytree(room[1].root, capture.root)
    generator = np.random.default_rng(0)
    for path in capture.images("thermal").glob("*.png"):
        noise = cv2.GaussianBlur(generator.normal(0, 1, (180, 240)), (0, 0), 3.0)
        cv2.imwrite(str(path), (29_500 + 4_000 * noise).astype(np.uint16))
    with pytest.raises(UserError, match=r"of 12 thermal images of .* could be placed"):
        register(capture)
