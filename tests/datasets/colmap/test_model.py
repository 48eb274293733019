"""COLMAP models: where they are found, what is read, and how damage is told."""

import shlex

import numpy as np
import pycolmap
import pytest

from capture_folders import rgb_image, synthetic_model, write_colmap_folder, write_image, write_model
from thermosplat.datasets import load_capture
from thermosplat.datasets.colmap.model import MODEL_FOLDERS, find_model, read_model
from thermosplat.errors import UserError


@pytest.mark.parametrize("folder", MODEL_FOLDERS)
def test_models_are_found_in_the_usual_places(tmp_path, folder):
    """sparse/0, the folder of RGBT-Scenes as downloaded, and both without the number."""
    write_model(synthetic_model(2), tmp_path / folder)
    assert find_model(tmp_path) == tmp_path / folder


def test_reading_gives_poses_cameras_and_points(tmp_path):
    """What pycolmap made is what is read, in binary and in text form."""
    model = synthetic_model(3)
    write_model(model, tmp_path / "binary")
    (tmp_path / "text").mkdir()
    model.write_text(tmp_path / "text")
    for kind in ("binary", "text"):
        got = read_model(tmp_path / kind)
        assert [image.name.name for image in got.images] == ["0000.png", "0001.png", "0002.png"]
        for image in got.images:
            expected = next(i for i in model.images.values() if i.name == image.name.name)
            np.testing.assert_allclose(image.viewmat[:3], expected.cam_from_world().matrix(), atol=1e-9)
            assert image.lens.model == "PINHOLE"
            assert image.lens.params == (40.0, 42.0, 16.0, 12.0)
        expected_points = np.array([point.xyz for point in model.points3D.values()])
        assert got.points.dtype == np.float64
        np.testing.assert_allclose(np.sort(got.points, 0), np.sort(expected_points, 0), atol=1e-5)
        assert got.point_colors.shape == (30, 3)
        assert got.point_colors.dtype == np.uint8


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin", "frames.bin", "cameras.bin"])
def test_damaged_models_are_told(tmp_path, name):
    """A file cut to nothing but a count, on which pycolmap may hang or abort, is a UserError."""
    write_model(synthetic_model(3), tmp_path)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:10])
    with pytest.raises(UserError, match="damaged"):
        read_model(tmp_path)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_two_images_of_one_name_are_refused(tmp_path, kind):
    """One of the two poses would be taken silently."""
    model = synthetic_model(3)
    next(image for image in model.images.values() if image.name == "0002.png").name = "0001.png"
    model.write_binary(tmp_path) if kind == "bin" else model.write_text(tmp_path)
    with pytest.raises(UserError, match=r"has 2 images that are called 0001\.png"):
        read_model(tmp_path)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_zero_quaternion_is_refused(tmp_path, kind):
    """pycolmap reads it as no rotation at all."""
    model = synthetic_model(3)
    if kind == "bin":
        write_model(model, tmp_path)
        content = bytearray((tmp_path / "frames.bin").read_bytes())
        content[16:48] = bytes(32)
        (tmp_path / "frames.bin").write_bytes(content)
    else:
        model.write_text(tmp_path)
        for name in ("rigs", "frames"):
            (tmp_path / f"{name}.txt").unlink()
        lines = (tmp_path / "images.txt").read_text().splitlines()
        place = next(number for number, line in enumerate(lines) if line.endswith("0001.png"))
        fields = lines[place].split()
        lines[place] = " ".join([fields[0], "0", "0", "0", "0", *fields[5:]])
        (tmp_path / "images.txt").write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"no rotation for '000.\.png'"):
        read_model(tmp_path)


def test_a_damaged_model_beside_an_empty_one(tmp_path):
    """A sibling that cannot be read is no better one."""
    write_colmap_folder(tmp_path, 8)
    few = synthetic_model(1)
    write_model(few, tmp_path / "sparse" / "0")
    write_model(synthetic_model(8), tmp_path / "sparse" / "1")
    (tmp_path / "sparse" / "1" / "points3D.bin").write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match="1 registered of 8 images"):
        load_capture(tmp_path)


def test_names_in_another_encoding_are_told(tmp_path):
    """COLMAP on Windows writes umlauts in the encoding of the system."""
    synthetic_model(2).write_text(tmp_path)
    text = (tmp_path / "images.txt").read_bytes()
    (tmp_path / "images.txt").write_bytes(text.replace(b"0001.png", b"f\xfcr.png"))
    with pytest.raises(UserError, match=r"f\\xfcr\.png', which is not UTF-8"):
        read_model(tmp_path)


def test_no_model(tmp_path):
    """The message says where a model was looked for and what was found, the hint how a capture or a model is made."""
    write_colmap_folder(tmp_path, 3)
    for path in (tmp_path / "sparse" / "0").iterdir():
        path.unlink()
    with pytest.raises(UserError, match="No COLMAP model") as caught:
        load_capture(tmp_path)
    assert "sparse/0, colmap/sparse/0" in caught.value.message
    assert "images/ (3 files)" in caught.value.message
    images = tmp_path / "images"
    command = f"colmap automatic_reconstructor --workspace_path {tmp_path} --image_path {images} --dense 0"
    prepare = f"become a capture, poses and all, with thermosplat-prepare {tmp_path} "
    assert prepare in caught.value.hint
    assert caught.value.hint.index(prepare) < caught.value.hint.index(command)


def test_the_command_that_makes_a_model_is_quoted(tmp_path):
    """A folder with a blank is one argument of the shell."""
    write_image(tmp_path / "my shed" / "rgb" / "a.png", rgb_image(0))
    with pytest.raises(UserError) as caught:
        load_capture(tmp_path / "my shed")
    words = shlex.split(caught.value.hint)
    assert words[words.index("thermosplat-prepare") + 1] == str(tmp_path / "my shed")
    assert words[words.index("--workspace_path") + 1] == str(tmp_path / "my shed")
    assert words[words.index("--image_path") + 1] == str(tmp_path / "my shed" / "rgb")


def test_empty_reconstruction_names_a_better_sibling(tmp_path):
    """A model with 1 of 12 images is refused; sparse/1, which has more, is pointed at."""
    write_colmap_folder(tmp_path, 12)
    write_model(synthetic_model(1), tmp_path / "sparse" / "0")
    with pytest.raises(UserError, match="1 registered of 12 images") as caught:
        load_capture(tmp_path)
    assert "overlap" in caught.value.hint
    write_model(synthetic_model(9), tmp_path / "sparse" / "1")
    with pytest.raises(UserError) as caught:
        load_capture(tmp_path)
    assert "sparse/1 has 9 images" in caught.value.hint


@pytest.mark.parametrize("points", [0, 3, 4])
def test_poses_without_points(tmp_path, points):
    """Scales come from the three nearest neighbours of a point: with fewer than four, random ones are started from."""
    write_colmap_folder(tmp_path, 4)
    model = synthetic_model(4)
    for point in sorted(model.points3D)[points:]:
        model.delete_point3D(point)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    if points == 4:
        assert len(capture.points) == 4
        assert capture.notes == ()
        return
    assert len(capture.points) == len(capture.point_colors) == 50_000
    assert any(f"has {points} points: starting from 50,000 random points" in note for note in capture.notes)
    np.testing.assert_array_equal(capture.points, load_capture(tmp_path).points)


def test_poses_without_points_beside_a_better_model(tmp_path):
    """A sibling model of more images is pointed at, rather than started without."""
    write_colmap_folder(tmp_path, 6)
    model = synthetic_model(4)
    for point in list(model.points3D):
        model.delete_point3D(point)
    write_model(model, tmp_path / "sparse" / "0")
    write_model(synthetic_model(6), tmp_path / "sparse" / "1")
    with pytest.raises(UserError, match="4 registered of 6 images and 0 points") as caught:
        load_capture(tmp_path)
    assert "sparse/1 has 6 images" in caught.value.hint


def test_no_pose_and_no_points(tmp_path):
    """There is nothing to put points around: the pose is the error."""
    write_colmap_folder(tmp_path, 4)
    model = synthetic_model(4)
    for point in list(model.points3D):
        model.delete_point3D(point)
    for frame in model.frames.values():
        _lose(frame)
    write_model(model, tmp_path / "sparse" / "0")
    with pytest.raises(UserError, match=r"pose of .* is not finite"):
        load_capture(tmp_path)


def test_points_that_are_nowhere_are_left_out(tmp_path):
    """A NaN among the sparse points costs that point and a note, not the run."""
    write_colmap_folder(tmp_path, 4)
    model = synthetic_model(4)
    first = min(model.points3D)
    model.points3D[first].xyz = np.array([0.0, np.nan, 1.0])
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert len(capture.points) == len(capture.point_colors) == len(model.points3D) - 1
    assert np.isfinite(capture.points).all()
    assert "1 of 30 starting points are not finite and were left out." in capture.notes


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda model: setattr(model.cameras[1], "params", [0.0, 42.0, 16.0, 12.0]),
            "camera of images/0000.png is imp",
        ),
        (lambda model: setattr(model.cameras[1], "params", [np.inf, 42.0, 16.0, 12.0]), "camera of images/0000.png is"),
        (lambda model: _lose(model.frames[1]), "pose of images/0000.png is not finite"),
    ],
)
def test_impossible_cameras_are_told(tmp_path, change, says):
    """A camera without a focal length, and an image that is nowhere, name the image."""
    write_colmap_folder(tmp_path, 4)
    model = synthetic_model(4)
    change(model)
    write_model(model, tmp_path / "sparse" / "0")
    with pytest.raises(UserError, match=says):
        load_capture(tmp_path)


def _lose(frame):
    frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.array([np.nan, 0.0, 0.0]))


def test_images_too_small_for_the_loss_are_told(tmp_path):
    """32x24 px divided by 5 are 6x5 px, on which SSIM has no value."""
    write_colmap_folder(tmp_path, 4)
    assert load_capture(tmp_path, data_factor=4).train[0].views["rgb"].camera.height == 6
    with pytest.raises(UserError, match=r"has 6x5 px with --data-factor 5 .* at least 6 px") as caught:
        load_capture(tmp_path, data_factor=5)
    assert "--data-factor" in caught.value.hint
