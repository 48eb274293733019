"""ThermoScenes and nerfstudio captures."""

import json

import numpy as np
import pytest

from capture_folders import HEIGHT, WIDTH, rgb_image, write_colmap_folder, write_image, write_transforms
from thermosplat.datasets import load_capture
from thermosplat.datasets.lens import Lens, rectification
from thermosplat.errors import UserError


def test_thermoscenes(tmp_path):
    """Names give the split, bounds the °C, grey the intensity; RGB and thermal share camera and pose."""
    write_transforms(tmp_path)
    capture = load_capture(tmp_path)
    assert capture.layout == "transforms"
    assert [frame.name for frame in capture.test] == ["frame_eval_00000", "frame_eval_00004"]
    assert len(capture.train) == 6
    assert capture.scales["thermal"].range == (-10.0, 41.0)
    frame = capture.train[0]
    assert frame.aligned
    camera = frame.views["rgb"].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (40.0, 60.0, 15.0, 12.5, WIDTH)
    np.testing.assert_allclose(frame.views["thermal"].values[:-1], -10 + 10 / 255 * 51, atol=1e-4)


def test_poses_turn_from_opengl_to_opencv(tmp_path):
    """An OpenGL camera at (1, 0.5, 2) looks along -z with y up: in OpenCV axes y and z are turned."""
    write_transforms(tmp_path)
    viewmat = load_capture(tmp_path).train[0].views["rgb"].viewmat
    np.testing.assert_allclose(viewmat @ [1, 0.5, 2, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(viewmat @ [1, 0.5, 1, 1], [0, 0, 1, 1], atol=1e-12)  # in front is +z
    np.testing.assert_allclose(viewmat @ [1, 1.5, 2, 1], [0, -1, 0, 1], atol=1e-12)  # above is -y


def test_distorted_images_are_undistorted_together(tmp_path):
    """OPENCV distortion: both spectra become pinhole images of one camera, and the user is told once."""
    write_transforms(tmp_path, camera_model="OPENCV", k1=-0.2, k2=0.01, p1=0.001, p2=0.0)
    capture = load_capture(tmp_path)
    assert all(frame.aligned for frame in capture.train)
    assert sum("OPENCV" in note for note in capture.notes) == 1
    assert capture.train[0].views["thermal"].image.shape[:2] != (HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("extra", "model"),
    [({"camera_model": "OPENCV_FISHEYE", "k1": 0.01}, "OPENCV_FISHEYE"), ({"k1": 0.1, "k3": 0.01}, "FULL_OPENCV")],
)
def test_other_distortion_models(tmp_path, extra, model):
    """Fisheye cameras, and a third radial coefficient."""
    write_transforms(tmp_path, **extra)
    assert any(model in note for note in load_capture(tmp_path).notes)


@pytest.mark.parametrize(
    ("model", "distortion", "same_as"),
    [
        ("SIMPLE_RADIAL", {"k1": -0.2}, "OPENCV"),
        ("RADIAL", {"k1": -0.2, "k2": 0.05}, "OPENCV"),
        ("SIMPLE_RADIAL_FISHEYE", {"k1": -0.02}, "OPENCV_FISHEYE"),
        ("RADIAL_FISHEYE", {"k1": -0.02, "k2": 0.01}, "OPENCV_FISHEYE"),
    ],
)
def test_radial_cameras(tmp_path, model, distortion, same_as):
    """nerfstudio's radial models: the same image as COLMAP's own model gives."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    write_transforms(tmp_path / "a", 2, camera_model=model, fl_y=40.0, **distortion)
    write_transforms(tmp_path / "b", 2, camera_model=same_as, fl_y=40.0, **distortion)
    got, same = (load_capture(tmp_path / folder).train[0].views["rgb"] for folder in "ab")
    assert got.camera == same.camera
    np.testing.assert_array_equal(got.image, same.image)
    params = (40.0, 15.0, 12.5, *distortion.values())
    expected = rectification(Lens(model, params, WIDTH, HEIGHT), WIDTH, HEIGHT)
    np.testing.assert_allclose(
        [got.camera.fx, got.camera.cx, got.camera.width],
        [expected.camera.fx, expected.camera.cx, expected.camera.width],
    )
    np.testing.assert_allclose(got.image.astype(float), expected.apply(rgb_image(1)), atol=1)


def test_intrinsics_per_frame(tmp_path):
    """A frame's own focal length wins over the file's."""
    content = write_transforms(tmp_path)
    content["frames"][1]["fl_x"] = 80.0
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert capture.train[0].views["rgb"].camera.fx == 80.0
    assert capture.train[1].views["rgb"].camera.fx == 40.0


def test_plain_nerfstudio(tmp_path):
    """transforms.json with names without ending, thermal found by stem, field of view, stated file lists."""
    content = write_transforms(tmp_path)
    (tmp_path / "transforms_thermal.json").unlink()
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del content[key]
    content["camera_angle_x"] = 2 * np.arctan(0.5 * WIDTH / 50)
    for frame in content["frames"]:
        frame["file_path"] = "./" + frame["file_path"][:-4]
        del frame["thermal_file_path"]
    content["train_filenames"] = [frame["file_path"] for frame in content["frames"][:5]]
    content["test_filenames"] = [frame["file_path"] for frame in content["frames"][5:]]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert [len(capture.train), len(capture.test)] == [5, 3]
    assert "thermal" in capture.train[0].views
    camera = capture.train[0].views["rgb"].camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx], [50, 50, WIDTH / 2])


def divided(root, **changes):
    """A capture whose images and thermal images lie in train/ and test/, each numbered from 0."""
    content = write_transforms(root)
    for number, frame in enumerate(content["frames"]):
        split, stem = ("test", number - 5) if number >= 5 else ("train", number)
        for folder in ("images", "thermal"):
            (root / folder / split).mkdir(exist_ok=True)
            path = root / frame["file_path"].replace("images", folder)
            path.rename(root / folder / split / f"{stem}.png")
        frame["file_path"] = f"images/{split}/{stem}.png"
        del frame["thermal_file_path"]
    (root / "transforms_thermal.json").write_text(json.dumps(content | changes))
    return content


@pytest.mark.parametrize("stated", [True, False])
def test_splits_that_are_numbered_apart(tmp_path, stated):
    """Equal stems in train/ and test/: each its own thermal image, name and split, stated or by the folders."""
    names = [f"./images/train/{n}.png" for n in range(5)], [f"./images/test/{n}.png" for n in range(3)]
    divided(tmp_path, **({"train_filenames": names[0], "test_filenames": names[1]} if stated else {}))
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.train] == [f"train_{number}" for number in range(5)]
    assert [frame.name for frame in capture.test] == [f"test_{number}" for number in range(3)]
    for number, frame in enumerate((*capture.train, *capture.test)):
        np.testing.assert_array_equal(frame.views["rgb"].image, rgb_image(number))
        np.testing.assert_allclose(frame.views["thermal"].image[:-1], 10 * number / 255, atol=1e-6)
        assert frame.views["rgb"].viewmat[0, 3] == -number


@pytest.mark.parametrize("held_out", ["test", "val"])
@pytest.mark.parametrize("absolute", [True, False])
def test_splits_by_folders(tmp_path, held_out, absolute):
    """train/ against test/ or val/ divides the frames also where no two have one stem; folders above do not."""
    root = tmp_path / "test"
    content = write_transforms(root)
    for number, frame in enumerate(content["frames"]):
        name = f"images/{'train' if number > 2 else held_out}/{number}.png"
        (root / name).parent.mkdir(exist_ok=True)
        (root / frame["file_path"]).rename(root / name)
        frame["file_path"] = str(root / name) if absolute else name
    (root / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(root)
    assert [frame.views["rgb"].viewmat[0, 3] for frame in capture.test] == [0, -1, -2]
    assert len(capture.train) == 5


def test_a_thermal_image_that_may_be_of_two_frames(tmp_path):
    """A flat thermal/ beside images of equal stems in train/ and test/ is not guessed at."""
    divided(tmp_path)
    for number in range(5):
        (tmp_path / "thermal" / "train" / f"{number}.png").rename(tmp_path / "thermal" / f"{number}.png")
    for number in range(3):
        (tmp_path / "thermal" / "test" / f"{number}.png").unlink()
    expected = r"images/train/0\.png and images/test/0\.png of transforms_thermal\.json have one stem, and 0\.png of th"
    with pytest.raises(UserError, match=expected):
        load_capture(tmp_path)


def test_names_without_a_split_fall_back_to_every_nth(tmp_path):
    """Frames that are all called train leave the hold-out rule to decide."""
    content = write_transforms(tmp_path)
    content["frames"] = [frame for frame in content["frames"] if "train" in frame["file_path"]]
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path, test_every=3)
    assert [len(capture.train), len(capture.test)] == [4, 2]


def test_files_that_windows_named(tmp_path):
    """Backslashes between folders are read as slashes, in the lists of file names too."""
    content = write_transforms(tmp_path)
    for frame in content["frames"]:
        frame["file_path"], frame["thermal_file_path"] = (
            frame[key].replace("/", "\\") for key in ("file_path", "thermal_file_path")
        )
    names = [frame["file_path"] for frame in content["frames"]]
    content |= {"train_filenames": names[2:], "test_filenames": names[:2]}
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.test] == ["frame_eval_00000", "frame_train_00001"]
    assert all({"rgb", "thermal"} <= frame.views.keys() for frame in (*capture.train, *capture.test))
    assert not any("names no file" in note for note in capture.notes)


def test_an_image_of_two_frames(tmp_path):
    """It could be held out and trained on at once."""
    content = write_transforms(tmp_path)
    again = content["frames"][1] | {"file_path": "./" + content["frames"][1]["file_path"]}
    content["frames"].append(again)
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"lists images/frame_train_00001\.png in two frames"):
        load_capture(tmp_path)


def test_missing_files_are_counted(tmp_path):
    """Frames whose files are gone are left out with a note; if all are gone it is an error."""
    content = write_transforms(tmp_path)
    stem = "frame_train_00001"
    (tmp_path / "images" / f"{stem}.png").unlink()
    (tmp_path / "thermal" / f"{stem}.png").unlink()
    left_out = f"1 of 8 frames of transforms_thermal.json have no file and were left out (first: images/{stem}.png)."
    capture = load_capture(tmp_path)
    assert left_out in capture.notes
    assert not any("names no file" in note for note in capture.notes)
    for frame in content["frames"]:
        frame["file_path"] = frame["thermal_file_path"] = "elsewhere/" + frame["file_path"].replace("frame", "x")
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"None of the 8 images .* \(first: .*/elsewhere/images/x_eval_00000\.png\)"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frames": []}, "lists no frames"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"camera_model": "SPHERICAL"}, "SPHERICAL"),
        ({"frames": ["images/a.png"]}, r'Frame 0 of .* must be an object, found "images/a\.png"'),
        ({"frames": [{"file_path": 5}]}, r"file_path of frame 0 of .* must be a file name, found 5"),
        ({"frames": [{"transform_matrix": []}]}, r"Frame 0 of .* has no file_path"),
        ({"w": "wide"}, r"Frame 0 of .* has intrinsics that are no numbers"),
        ({"k1": "strong"}, r"Frame 0 of .* has intrinsics that are no numbers"),
        ({"fl_x": -40.0}, r"camera of images/frame_eval_00000\.png is impossible: PINHOLE of 32x24 px"),
        ({"fl_y": 0}, "impossible"),
        ({"cx": float("nan")}, "impossible"),
        ({"w": 0}, "impossible"),
    ],
)
def test_broken_transforms_are_told(tmp_path, change, says):
    """What a transforms file lacks is named."""
    content = write_transforms(tmp_path) | change
    content = {key: value for key, value in content.items() if value is not None}
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=says) as caught:
        load_capture(tmp_path)
    assert caught.value.hint


@pytest.mark.parametrize("matrix", [None, [[1, 2], [3, 4]], (2 * np.eye(4)).tolist(), np.full((4, 4), np.nan).tolist()])
def test_broken_poses_are_told(tmp_path, matrix):
    """A missing, misshapen, scaled or undefined pose names its frame."""
    content = write_transforms(tmp_path)
    content["frames"][2]["transform_matrix"] = matrix
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"Frame 2 of .*transforms_thermal\.json") as caught:
        load_capture(tmp_path)
    assert caught.value.hint


def test_broken_json_is_told(tmp_path):
    """A transforms file that is no JSON is a UserError."""
    write_transforms(tmp_path)
    (tmp_path / "transforms_thermal.json").write_text("{")
    with pytest.raises(UserError, match="not readable JSON"):
        load_capture(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_json_as_windows_saves_it(tmp_path, encoding):
    """Editors there put a byte-order mark before it."""
    content = write_transforms(tmp_path)
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content), encoding=encoding)
    assert len(load_capture(tmp_path).train) == 6


def test_transforms_win_over_a_model_beside_images(tmp_path):
    """ThermoScenes ships a COLMAP model of unprocessed images; the transforms file is what counts."""
    write_colmap_folder(tmp_path, 3)
    write_transforms(tmp_path)
    assert load_capture(tmp_path).layout == "transforms"


@pytest.mark.parametrize("absolute", [True, False])
def test_one_stem_in_several_folders(tmp_path, absolute):
    """images/a/0000 has the thermal image and the values of a/0000, not those of b/0000."""
    content = write_transforms(tmp_path)
    for number, frame in enumerate(content["frames"]):
        source = frame.pop("thermal_file_path")
        name = f"{'ab'[number % 2]}/{number // 2:04d}.png"
        for stated, folder in ((frame["file_path"], "images"), (source, "thermal")):
            (tmp_path / folder / name).parent.mkdir(exist_ok=True)
            (tmp_path / stated).rename(tmp_path / folder / name)
        write_image(tmp_path / "thermal_raw" / name, np.full((HEIGHT, WIDTH), 29000 + number, np.uint16))
        frame["file_path"] = str(tmp_path / "images" / name) if absolute else f"images/{name}"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    frames = capture.train + capture.test
    assert len(frames) == 8
    for frame in frames:
        assert frame.views["thermal"].path.parts[-2:] == frame.views["rgb"].path.parts[-2:]
        number = 2 * int(frame.views["rgb"].name) + (frame.views["rgb"].path.parent.name == "b")
        np.testing.assert_allclose(frame.views["thermal"].values, (29000 + number) / 100 - 273.15, atol=1e-3)


@pytest.mark.parametrize(("key", "other"), [("file_path", "thermal"), ("thermal_file_path", "rgb")])
def test_files_that_are_named_and_missing(tmp_path, key, other):
    """The other image of the frame stands alone; a note names the path that was tried."""
    content = write_transforms(tmp_path)
    for number in (2, 3):
        (tmp_path / content["frames"][number][key]).unlink()
    capture = load_capture(tmp_path)
    assert sum(other in frame.views for frame in capture.train) == 6
    assert sum(len(frame.views) == 2 for frame in capture.train) == 4
    first = tmp_path / content["frames"][2][key]
    assert f"{key} of 2 of 8 frames of transforms_thermal.json names no file (first: {first})." in capture.notes


def test_a_thermal_image_in_place_of_the_named_one(tmp_path):
    """The file of the frame's name in thermal/ is taken, and that is said."""
    content = write_transforms(tmp_path)
    content["frames"][1]["thermal_file_path"] = "infrared/gone.png"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert capture.train[0].views["thermal"].name == capture.train[0].name
    note = next(note for note in capture.notes if "names no file" in note)
    assert "infrared/gone.png" in note
    assert "1 of them have a thermal image of their own name, which was taken" in note
