"""Poses of photographs, what is said where there are none, and a step that goes on after it was killed."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from flown_model import ORIGIN, rows_at
from seen_room import SeenRoom, seen_room, write_room
from thermosplat.datasets.geo_file import read_geo
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.structure import sfm
from thermosplat.prepare.structure.sfm import run_sfm


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[SeenRoom, CaptureFolder]:
    made = seen_room()
    return made, write_room(made, tmp_path_factory.mktemp("room") / "capture")


def poses(capture: CaptureFolder) -> dict[str, np.ndarray]:
    model = pycolmap.Reconstruction(capture.sparse)
    return {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in model.images.values()}


def copied(capture: CaptureFolder, to: Path) -> CaptureFolder:
    """The capture as it was imported."""
    shutil.copytree(capture.root, to, ignore=shutil.ignore_patterns("prepared", "sparse"))
    return CaptureFolder(to)


@pytest.mark.rotating("structure from motion")
def test_photographs_of_a_room_have_their_poses(room: tuple[SeenRoom, CaptureFolder]) -> None:
    """Relative rotations agree with the truth to 0.2°, and the model's names are below images/."""
    truth, capture = room
    report = run_sfm(capture)
    found = poses(capture)
    assert sorted(found) == [f"rgb/{number:03}.jpg" for number in range(12)]
    assert report.sentences[0].startswith("12 of 12 photographs have a pose")
    first = found["rgb/000.jpg"]
    for number in range(1, 12):
        mine = found[f"rgb/{number:03}.jpg"] @ np.linalg.inv(first)
        true = truth.viewmats[number] @ np.linalg.inv(truth.viewmats[0])
        turn = cv2.Rodrigues(mine[:3, :3] @ true[:3, :3].T)[0]
        assert np.degrees(np.linalg.norm(turn)) < 0.2
    assert run_sfm(capture).before


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", "missing"])
def test_a_photograph_that_is_no_file(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path, kind: str) -> None:
    """It is named before COLMAP waits for it."""
    capture = copied(room[1], tmp_path / "capture")
    path = capture.images("rgb") / "003.jpg"
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    with pytest.raises(UserError, match=r"003\.jpg is listed in frames\.csv, and there is no such file"):
        run_sfm(capture)


@pytest.mark.rotating("structure from motion")
def test_a_killed_step_goes_on(
    room: tuple[SeenRoom, CaptureFolder], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Features that were found before are not looked for again; nothing half-done is called complete."""
    capture = copied(room[1], tmp_path / "capture")

    def killed(database: Path, places: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sfm, "match", killed)
        with pytest.raises(KeyboardInterrupt):
            run_sfm(capture)
    assert not capture.marker("sfm").exists()
    assert not capture.sparse.exists()
    asked: list[str] = []
    extract_features = pycolmap.extract_features
    monkeypatch.setattr(
        pycolmap,
        "extract_features",
        lambda *args, **options: (asked.extend(options["image_names"]), extract_features(*args, **options)),
    )
    report = run_sfm(capture)
    assert asked == []
    assert report.sentences[0].startswith("12 of 12")


@pytest.mark.rotating("structure from motion")
def test_what_has_no_pose_is_named_with_the_reason(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """A blank photograph has too few features; one of noise matches nothing; one that is cut off cannot be read."""
    capture = copied(room[1], tmp_path / "capture")
    rgb = capture.images("rgb")
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3)).astype(np.uint8)
    for name, content in {
        "006": np.full((300, 400, 3), 90, np.uint8),
        "007": cv2.GaussianBlur(noise, (0, 0), 1.5),
    }.items():
        (rgb / f"{name}.jpg").unlink()
        cv2.imwrite(str(rgb / f"{name}.jpg"), content)
    (rgb / "008.jpg").write_bytes(b"no picture")
    said = "\n".join(run_sfm(capture).sentences)
    assert "9 of 12 photographs have a pose" in said
    assert "fewer than 100 features (blurred, dark or without texture): 006.jpg" in said
    assert "they match no other photograph (no overlap): 007.jpg" in said
    assert "cannot be read: 008.jpg" in said


def test_two_photographs_are_too_few(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """The sentence says how many there are."""
    capture = copied(room[1], tmp_path / "capture")
    capture.write_frames(capture.read_frames("rgb")[:2])
    with pytest.raises(UserError, match=r"has 2 photographs, and poses need at least 3"):
        run_sfm(capture)


def test_photographs_without_texture_make_no_model(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """All of them are blank: the sentence says so, and nothing is written."""
    capture = copied(room[1], tmp_path / "capture")
    for path in capture.images("rgb").iterdir():
        cv2.imwrite(str(path), np.full((300, 400, 3), 90, np.uint8))
    with pytest.raises(UserError, match=r"None of the 12 photographs .* fewer than 100 features"):
        run_sfm(capture)
    assert not capture.sparse.exists()


@pytest.mark.rotating("structure from motion")
def test_photographs_with_gps_are_in_metres(room: tuple[SeenRoom, CaptureFolder], tmp_path: Path) -> None:
    """The room ten times as large, somewhere on the Earth: cameras lie where GPS has them, and geo.json says where."""
    truth, capture = room[0], copied(room[1], tmp_path / "capture")
    places = 10.0 * np.linalg.inv(truth.viewmats)[:, :3, 3]
    rows = [
        replace(placed, spectrum="rgb", file=row.file, source=row.source, width=row.width, height=row.height)
        for row, placed in zip(capture.read_frames("rgb"), rows_at(places, rtk_flag=[50] * 12))
    ]
    capture.write_frames(rows)
    said = " ".join(run_sfm(capture).sentences)
    geo = read_geo(capture.root)
    assert geo is not None
    assert geo.residual < 0.1
    assert "12 cameras lie 0.0" in said
    centres = np.array([np.linalg.inv(pose)[:3, 3] for _, pose in sorted(poses(capture).items())])
    degrees = pycolmap.GPSTransform().enu_to_ellipsoid(centres, geo.latitude, geo.longitude, geo.altitude)
    found = pycolmap.GPSTransform().ellipsoid_to_enu(degrees, *ORIGIN)
    np.testing.assert_allclose(found, places, atol=0.1)
    capture.write_frames([replace(row, latitude=None) for row in rows])
    run_sfm(capture)
    assert not capture.geo_json.exists()  # it would be of another model
