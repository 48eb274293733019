"""Rendered captures: the scenes are those that were published; scores of images in degrees."""

import json
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from rendered_captures.__main__ import main
from rendered_captures.files.flight_plan import flight_poses
from rendered_captures.meshes.mesh import move, vertex_normals
from rendered_captures.meshes.solids import mesh_ball, mesh_box
from rendered_captures.paths import FLIP, look_at
from rendered_captures.planck import radiance_of, temperature_of
from rendered_captures.scenes.block import block
from rendered_captures.scenes.desk import desk
from rendered_captures.scenes.lab import lab
from rendered_captures.scenes.yard import yard
from rendered_captures.sensors.lens import Lens
from rendered_captures.sensors.palette import ironbow
from rendered_captures.sensors.shutter import motions
from rendered_captures.sensors.thermal_image import counts, drifting_levels

PUBLISHED = {
    "desk": (
        [1.330413, 0.002411, 1.305998],
        [-0.946824, 0.001694, -0.321747],
        {"wall_e": (20.12, 29.44), "bigplant_pot": (20.25, 20.75), "chrome": (22.3, 22.7)},
    ),
    "lab": (
        [-1.895095, -1.284048, 1.450878],
        [0.443385, 0.890002, -0.106332],
        {"wall_n": (20.89, 34.45), "bottle1": (21.65, 21.95), "pipe0": (47.76, 56.26)},
    ),
    "yard": (
        [-6.485775, -1.754012, 2.223638],
        [0.725786, 0.68301, -0.082048],
        {"plaster": (24.7, 37.49), "window4": (23.78, 24.89), "bollard": (26.75, 27.25)},
    ),
}
"""Place and direction of the first camera, and temperatures, of the published captures."""


@pytest.mark.parametrize("name", ["desk", pytest.param("lab", marks=pytest.mark.slow)])
def test_a_scene_is_the_published_one(name: str) -> None:
    """Cameras and temperatures are those of the shipped files."""
    _same_as_published(name)


@pytest.mark.slow
def test_the_yard_is_the_published_one() -> None:
    """As above, of the scene with the largest textures."""
    _same_as_published("yard")


def _same_as_published(name: str) -> None:
    build: Callable = {"desk": desk, "lab": lab, "yard": yard}[name]
    key, (place, direction, temperatures) = zlib.crc32(name.encode()), PUBLISHED[name]
    scene, path = build(np.random.default_rng([7, key]))
    places, targets = path(48, np.random.default_rng([7, 1, key]))
    pose = look_at(places[0], targets[0])
    np.testing.assert_allclose(pose[:3, 3], place, atol=1e-6)
    np.testing.assert_allclose(pose[:3, 2], direction, atol=1e-6)
    found = {thing.name: (float(np.min(thing.T)), float(np.max(thing.T))) for thing in scene.objs}
    for thing, expected in temperatures.items():
        assert found[thing] == pytest.approx(expected, abs=0.006), thing


@pytest.mark.parametrize(
    ("date", "frames", "place"),
    [
        (0, 104, [-31.907427986711046, -22.84673527201599, 34.20095649237177]),
        (1, 82, [-31.2711478359726]),
        (2, 92, []),
    ],
)
def test_flights_go_where_the_published_ones_went(date: int, frames: int, place: list[float]) -> None:
    """Number of frames and place of the first, of truth.json; another number of views keeps the path's shape."""
    poses = flight_poses(3, date)
    assert len(poses) == frames
    np.testing.assert_allclose((poses[0] @ FLIP)[: len(place), 3], place, atol=1e-9)
    many = flight_poses(3, date, 400)
    assert abs(len(many) - 400) < 20
    extents = [np.ptp([pose[:2, 3] for pose in path], axis=0) for path in (poses, many)]
    np.testing.assert_allclose(*extents, atol=3)


@pytest.mark.slow
def test_the_block_has_the_published_anomalies() -> None:
    """All dates list what was wrong with the houses: a cell is repaired, a wet patch comes, the leak grows."""
    dates = [block(3, date)[1] for date in range(3)]
    kinds = [[one["kind"] for one in date] for date in dates]
    assert [date.count("hot cell") for date in kinds] == [3, 2, 2]
    assert [date.count("wet insulation") for date in kinds] == [1, 1, 2]
    leaks = [next(one for one in date if one["kind"] == "leak") for date in dates]
    assert [leak["area_m2"] for leak in leaks] == pytest.approx([37.12, 103.1, 183.29])
    assert [(leak["x"], leak["y"]) for leak in leaks] == [(14.3, -8.6)] * 3


def test_black_bodies_keep_their_temperature() -> None:
    """Radiance and back, to a millikelvin between the table's rows; radiance grows with temperature."""
    celsius = np.linspace(-60, 400, 997)
    np.testing.assert_allclose(temperature_of(radiance_of(celsius)), celsius, atol=1e-3)
    of_all = 5.670374e-8 * 293.15**4 / np.pi  # Stefan and Boltzmann; tables of black bodies give the band 37.1%
    assert radiance_of(20.0) == pytest.approx(0.371 * of_all, rel=0.005)


def test_a_lens_without_distortion_leaves_the_render() -> None:
    """The wider render's middle is the image; with distortion straight lines bend."""
    straight = Lens(40, 30, 50.0, 20.0, 15.0, 0.0, 0.0, margin=1.2)
    width, height = straight.rendered_size
    render = np.random.default_rng(1).random((height, width)).astype(np.float32)
    inner = render[(height - 30) // 2 : (height + 30) // 2, (width - 40) // 2 : (width + 40) // 2]
    np.testing.assert_allclose(straight.bent(render), inner, atol=1e-5)
    bent = Lens(40, 30, 50.0, 20.0, 15.0, -0.3, 0.0, margin=1.2)
    assert np.abs(bent.bent(render) - inner).max() > 0.1
    assert bent.scaled(2).rendered_size == (96, 72)


def test_levels_jump_where_the_shutter_closes() -> None:
    """Between two closings a level drifts slowly; its span is what was asked for; counts are centikelvin."""
    levels = drifting_levels(96, np.random.default_rng(2), 24, 2.0)
    assert np.ptp(levels) == pytest.approx(2.0)
    steps = np.abs(np.diff(levels))
    assert steps[[23, 47, 71]].max() > 2 * np.median(steps)
    assert counts(np.array([[0.0]])).tolist() == [[27316]]


def test_motion_during_a_readout_is_that_of_the_path() -> None:
    """Half the step between frames where the readout takes half the time."""
    poses = [np.eye(4) for _ in range(4)]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.2 * k
        pose[:3, :3] = cv2.Rodrigues(np.array([0, 0.1 * k, 0]))[0]
    for velocity, turn in motions(poses, 0.5):
        np.testing.assert_allclose(velocity, [0.1, 0, 0], atol=1e-9)
        np.testing.assert_allclose(turn, [0, 0.05, 0], atol=1e-9)


def test_shapes_are_closed_and_keep_their_form() -> None:
    """Normals point outwards; a turned box keeps its size."""
    ball = mesh_ball(1.0, np.random.default_rng(0))
    normals = vertex_normals(ball.vertices, ball.faces)
    assert ((normals * ball.vertices).sum(axis=1)[len(normals) // 3 : len(normals) // 2] > 0.9).all()
    box = move(mesh_box((1, 2, 3)), (5, 5, 5), rz=30, rx=20)
    np.testing.assert_allclose(np.linalg.norm(box.vertices - 5, axis=1), np.sqrt(1 + 4 + 9) / 2)


def test_the_palette_grows_brighter() -> None:
    """256 colours of strictly growing luma, from black to white."""
    pytest.importorskip("scipy")
    palette = ironbow()
    assert (np.diff(palette @ np.array([0.2126, 0.7152, 0.0722])) > 0).all()
    assert palette[0].tolist() == [0, 0, 0]
    assert palette[255].tolist() == [255, 255, 255]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Two held-out views, the right half glass; the camera's level was 1 K too high in the second."""
    folder = tmp_path / "capture"
    (folder / "ground_truth").mkdir(parents=True)
    (folder / "thermal_raw").mkdir()
    label = np.zeros((4, 6), np.uint8)
    label[:, 3:] = 1
    for k in range(2):
        np.savez(folder / "ground_truth" / f"v{k}.npz", label=label)
        tifffile.imwrite(folder / "thermal_raw" / f"v{k}.tiff", counts(np.full((4, 6), 20.0 + k)))
    (folder / "level_drift_K.json").write_text(json.dumps({"v0.tiff": 0.0, "v1.tiff": 1.0}))
    return folder


@pytest.mark.parametrize("kind", ["floats", "centikelvin", "npy"])
def test_scores_are_the_errors_by_region(capture: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Half a kelvin too warm before glass alone; the drifted level is no error; all kinds of files agree."""
    images = capture.parent / "images"
    images.mkdir()
    for k in range(2):
        image = tifffile.imread(capture / "thermal_raw" / "v0.tiff") / 100.0 - 273.15
        image[:, 3:] += 0.5
        if kind == "npy":
            np.save(images / f"v{k}.npy", image)
        elif kind == "floats":
            tifffile.imwrite(images / f"v{k}.tiff", image.astype(np.float32))
        else:
            cv2.imwrite(str(images / f"v{k}.png"), np.round((image + 273.15) * 100).astype(np.uint16))
    assert main(["score", str(images), str(capture)]) == 0
    rows = {line.split("|")[1].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert "| 48 | 0.250 | +0.250 | 0.354 |" in rows["all"]
    assert "| 24 | 0.500 | +0.500 | 0.500 |" in rows["glass"]


@pytest.mark.parametrize("fault", ["missing", "size", "bytes", "nan", "no capture"])
def test_what_cannot_be_scored_is_refused(capture: Path, fault: str, capsys: pytest.CaptureFixture[str]) -> None:
    """By one sentence, not by a mean over what is left."""
    images = capture.parent / "images"
    images.mkdir()
    good = np.full((4, 6), 20.0, np.float32)
    bad = {"size": good[:2], "bytes": good.astype(np.uint8), "nan": good * np.nan}.get(fault, good)
    tifffile.imwrite(images / "v0.tiff", bad)
    if fault != "missing":
        tifffile.imwrite(images / "v1.tiff", good)
    said = {"missing": "no image of 1 of the 2", "size": "6x2 and 6x4", "bytes": "16 bits or floats"}
    assert main(["score", str(images), str(images if fault == "no capture" else capture)]) == 2
    said |= {"nan": "no numbers", "no capture": "no rendered capture"}
    assert said[fault] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "expected"),
    [(["--views", "0"], "more than 0"), (["--variant", "scalar_rgb"], ""), (["--size", "4by3"], "")],
)
def test_impossible_flags_are_refused(
    flags: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is rendered or written."""
    assert main(["desk", "--out", str(tmp_path / "new"), *flags]) == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_folder_that_holds_something_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A capture is not rendered over another one."""
    (tmp_path / "note.txt").write_text("mine")
    assert main(["desk", "--out", str(tmp_path)]) == 2
    assert "holds something" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.slow
@pytest.mark.parametrize("flags", [[], ["--drift", "2", "--jump-every", "3", "--electrons", "140"]])
def test_a_small_capture_is_whole(flags: list[str], tmp_path: Path) -> None:
    """Rendered at 32x24, it loads, and its own images score no error but its noise."""
    pytest.importorskip("mitsuba")
    from thermosplat.datasets import load_capture

    small = ["--size", "32x24", "--views", "9", "--samples", "2", *flags]
    assert main(["desk", "--out", str(tmp_path / "desk"), *small]) == 0
    loaded = load_capture(tmp_path / "desk")
    assert (len(loaded.train), len(loaded.test)) == (7, 2)
    assert len(list((tmp_path / "desk/labels").rglob("*.png"))) == 9
    assert (tmp_path / "desk/LICENSE.txt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("flags", [[], ["--unpaired", "--readout", "0.5"]])
def test_a_small_rig_is_whole(flags: list[str], tmp_path: Path) -> None:
    """Files of both cameras, and a truth that names them."""
    pytest.importorskip("mitsuba")
    small = ["--size-factor", "0.05", "--views", "3", "--samples", "2", *flags]
    assert main(["rig_desk", "--out", str(tmp_path / "rig"), *small]) == 0
    truth = json.loads((tmp_path / "rig/truth.json").read_text())
    assert sorted(truth["camera_to_world"]) == sorted(path.name for path in (tmp_path / "rig/visible").iterdir())
    thermal = tifffile.imread(tmp_path / "rig/thermal/IR_0001.tiff")
    assert thermal.shape == (truth["thermal"]["height"], truth["thermal"]["width"]) == (12, 16)
    assert 10 < np.median(thermal) / 100 - 273.15 < 40
    assert ("thermal_camera_to_world" in truth) == (tmp_path / "rig/shutter.json").is_file() == bool(flags)
