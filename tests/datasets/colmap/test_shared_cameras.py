"""The RGBT-Scenes layout."""

import shutil

import numpy as np
import pytest

from capture_folders import (
    HEIGHT,
    WIDTH,
    pseudo_color,
    rgb_image,
    spectra_with,
    synthetic_model,
    temperatures,
    write_image,
    write_model,
    write_rgbt_scenes,
)
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError


def names(frames) -> list[str]:
    return [frame.name for frame in frames]


def test_published_form(tmp_path):
    """The folders give the split; both views of a frame share camera and pose; images are read as they are."""
    capture = load_capture(write_rgbt_scenes(tmp_path / "shed"))
    assert capture.name == "shed"
    assert capture.layout == "rgbt-scenes"
    assert names(capture.test) == ["0000", "0004"]
    assert names(capture.train) == ["0001", "0002", "0003", "0005", "0006", "0007"]
    assert capture.points.shape == capture.point_colors.shape == (30, 3)
    assert capture.notes == ()
    frame = capture.train[1]
    assert frame.aligned
    assert frame.views["rgb"].camera.width == WIDTH
    assert frame.views["rgb"].camera.fy == 42.0
    np.testing.assert_array_equal(frame.views["rgb"].image, rgb_image(2))
    np.testing.assert_array_equal(frame.views["thermal"].image, pseudo_color(temperatures(2)))
    expected = next(image for image in synthetic_model(8).images.values() if image.name == "0002.png")
    np.testing.assert_allclose(frame.views["rgb"].viewmat[:3], expected.cam_from_world().matrix(), atol=1e-9)


def test_downloaded_form(tmp_path):
    """colmap/sparse/0, as the data set is downloaded, and names in the model with another folder and ending."""
    root = write_rgbt_scenes(tmp_path)
    shutil.move(root / "sparse", root / "colmap" / "sparse")
    model = synthetic_model(8)
    for image in model.images.values():
        image.name = f"input/{image.name[:-4]}.JPG"
    write_model(model, root / "colmap" / "sparse" / "0")
    assert len(load_capture(root).train) == 6


def test_split_folders_in_capitals(tmp_path):
    """Train/ and Test/ divide as train/ and test/ do."""
    write_rgbt_scenes(tmp_path)
    for folder in ("rgb", "thermal"):
        for split in ("train", "test"):
            (tmp_path / folder / split).rename(tmp_path / folder / split.capitalize())
    assert [frame.name for frame in load_capture(tmp_path).test] == ["0000", "0004"]


def test_without_split_folders_every_nth_is_held_out(tmp_path):
    """Sorted index % test_every == 0."""
    root = write_rgbt_scenes(tmp_path, folders=False)
    assert names(load_capture(root).test) == ["0000"]
    assert names(load_capture(root, test_every=3).test) == ["0000", "0003", "0006"]


@pytest.mark.parametrize("folders", [True, False])
def test_radiometric_files_beside(tmp_path, folders):
    """thermal_raw/ with units.json gives degrees and the palette's span, flat or divided like the rest."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    if folders:
        for split in ("train", "test"):
            for path in (root / "rgb" / split).iterdir():
                (root / "thermal_raw" / split).mkdir(exist_ok=True)
                shutil.move(root / "thermal_raw" / path.name, root / "thermal_raw" / split / path.name)
    capture = load_capture(root)
    assert capture.scales["thermal"].range == (15.0, 35.0)
    np.testing.assert_allclose(capture.test[1].views["thermal"].values, temperatures(4), atol=0.006)
    raw = load_capture(root, spectra=spectra_with(thermal={"source": "raw"}))
    assert raw.scales["thermal"].kind == "scalar"
    assert raw.test[1].views["thermal"].image.shape == (HEIGHT, WIDTH, 1)


def renumber(root, *, model_folders):
    """Number test/ from 0000 like train/, as when each split was numbered on its own; so does the model, or not."""
    model = synthetic_model(8)
    by_name = {image.name: image for image in model.images.values()}
    for split in ("train", "test"):
        for spectrum in ("rgb", "thermal", "thermal_raw"):
            for number, path in enumerate(sorted((root / spectrum / split).glob("*.png"))):
                if spectrum == "rgb":
                    by_name[path.name].name = f"{split}/{number:04d}.png" if model_folders else f"{number:04d}.png"
                path.rename(path.with_name(f"{number:04d}.png"))
    if not model_folders:  # COLMAP knew one folder, in which a name is there once
        used = set()
        for image in model.images.values():
            if image.name in used:
                image.name = f"other_{image.name}"
            used.add(image.name)
    write_model(model, root / "sparse" / "0")


def test_splits_that_are_numbered_apart(tmp_path):
    """train/0000 and test/0000 are two frames, each with its own images, pose and degrees, and names that differ."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    for split in ("train", "test"):
        (root / "thermal_raw" / split).mkdir()
        for path in (root / "rgb" / split).iterdir():
            shutil.move(root / "thermal_raw" / path.name, root / "thermal_raw" / split / path.name)
    before = load_capture(root)
    renumber(root, model_folders=True)
    capture = load_capture(root)
    assert names(capture.train) == [f"train_{number:04d}" for number in range(6)]
    assert names(capture.test) == ["test_0000", "test_0001"]
    assert capture.notes == before.notes == ()
    for frame, same in zip((*capture.train, *capture.test), (*before.train, *before.test), strict=True):
        np.testing.assert_array_equal(frame.views["rgb"].image, same.views["rgb"].image)
        np.testing.assert_array_equal(frame.views["thermal"].image, same.views["thermal"].image)
        np.testing.assert_array_equal(frame.views["thermal"].values, same.views["thermal"].values)
        np.testing.assert_array_equal(frame.views["rgb"].viewmat, same.views["rgb"].viewmat)


def test_splits_that_are_numbered_apart_and_a_model_that_is_not(tmp_path):
    """Which of two images of one stem a pose belongs to is not guessed."""
    root = write_rgbt_scenes(tmp_path)
    renumber(root, model_folders=False)
    with pytest.raises(
        UserError, match=r"test/0000\.png and train/0000\.png of rgb/ have one stem, and 0000\.png of the C"
    ):
        load_capture(root)


def test_flat_radiometric_files_of_splits_that_are_numbered_apart(tmp_path):
    """Nor is it which of two thermal images degrees belong to."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    renumber(root, model_folders=True)
    with pytest.raises(
        UserError, match=r"of thermal/ have one stem, and 0000\.png of thermal_raw/ may belong to either"
    ):
        load_capture(root)


def test_data_factor_shrinks_images_degrees_and_intrinsics(tmp_path):
    """Images, degrees and intrinsics shrink together; one pixel is the mean of its block."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True), data_factor=4)
    frame = capture.train[0]
    assert frame.aligned
    assert frame.views["rgb"].image.shape == (6, 8, 3)
    assert frame.views["thermal"].values.shape == (6, 8)
    assert (frame.views["rgb"].camera.width, frame.views["rgb"].camera.fx) == (8, 10.0)
    np.testing.assert_allclose(frame.views["thermal"].values[1, 2], temperatures(1)[4:8, 8:12].mean(), atol=0.01)
    with pytest.raises(UserError, match="--data-factor"):
        load_capture(tmp_path, data_factor=0)


def test_files_of_another_size_scale_the_camera(tmp_path):
    """A thermal image of half the size keeps its pixels and gets half the focal length; the pair is not aligned."""
    root = write_rgbt_scenes(tmp_path)
    write_image(root / "thermal" / "train" / "0001.png", pseudo_color(temperatures(1, WIDTH // 2, HEIGHT // 2)))
    frame = load_capture(root).train[0]
    assert frame.views["thermal"].camera.fx == frame.views["rgb"].camera.fx / 2
    assert frame.views["thermal"].image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert not frame.aligned


def test_image_of_another_aspect(tmp_path):
    """A cropped RGB image is an error that names both sizes."""
    root = write_rgbt_scenes(tmp_path)
    write_image(root / "rgb" / "train" / "0001.png", rgb_image(1, 32, 32))
    with pytest.raises(UserError, match=r"0001\.png is 32x32 but its camera was calibrated at 32x24"):
        load_capture(root)


def test_rgb_without_thermal_is_counted(tmp_path):
    """Frames without a thermal image are kept for RGB and counted in a note."""
    root = write_rgbt_scenes(tmp_path)
    for number in (2, 3):
        (root / "thermal" / "train" / f"{number:04d}.png").unlink()
    capture = load_capture(root)
    assert "thermal" not in capture.train[1].views
    assert "rgb" in capture.train[1].views
    assert not capture.train[1].aligned
    assert any(note.startswith("2 of 8 frames have no thermal image (first: 0002)") for note in capture.notes)
    assert any("they are trained on RGB alone" in note for note in capture.notes)


def test_files_and_model_that_do_not_meet_are_counted(tmp_path):
    """Files without a pose and poses without a file are left out, with a note each."""
    root = write_rgbt_scenes(tmp_path)
    write_image(root / "rgb" / "train" / "extra.png", rgb_image(9))
    for spectrum in ("rgb", "thermal"):
        (root / spectrum / "train" / "0007.png").unlink()
    capture = load_capture(root)
    assert len(capture.train) == 5
    assert any("1 images are not in the COLMAP model" in note and "extra.png" in note for note in capture.notes)
    assert any("1 images of the COLMAP model have no file" in note for note in capture.notes)


def test_empty_split_folder(tmp_path):
    """train/ without test/ images would leave nothing to evaluate on."""
    root = write_rgbt_scenes(tmp_path)
    for spectrum in ("rgb", "thermal"):
        shutil.rmtree(root / spectrum / "test")
    with pytest.raises(UserError, match="test/ is empty") as caught:
        load_capture(root)
    assert "--test-every" in caught.value.hint


def test_one_spectrum_alone(tmp_path):
    """RGB-only and thermal-only captures load; what is missing is only an error where it is needed."""
    root = write_rgbt_scenes(tmp_path / "rgb_only")
    shutil.rmtree(root / "thermal")
    capture = load_capture(root)
    assert "thermal" not in capture.scales
    capture.require(["rgb"])
    with pytest.raises(UserError, match="no thermal images"):
        capture.require(["rgb", "thermal"])
    root = write_rgbt_scenes(tmp_path / "thermal_only")
    shutil.rmtree(root / "rgb")
    capture = load_capture(root)
    assert all("rgb" not in frame.views and "thermal" in frame.views for frame in capture.train)
    with pytest.raises(UserError, match="no RGB images"):
        capture.require(["rgb"])


def test_distorted_cameras_are_undistorted_once_said(tmp_path):
    """Both spectra are resampled by the same map and stay aligned; one note names the camera model."""
    root = write_rgbt_scenes(tmp_path)
    write_model(synthetic_model(8, camera_model="SIMPLE_RADIAL", params=(40.0, 16.0, 12.0, 0.1)), root / "sparse" / "0")
    capture = load_capture(root)
    assert all(frame.aligned for frame in capture.train)
    assert capture.train[0].views["rgb"].image.shape[:2] == (
        capture.train[0].views["rgb"].camera.height,
        capture.train[0].views["rgb"].camera.width,
    )
    assert sum("SIMPLE_RADIAL" in note for note in capture.notes) == 1


def test_own_palette_of_the_capture(tmp_path):
    """ironbow_lut.json in the folder is the palette; --thermal.palette wins over it."""
    root = write_rgbt_scenes(tmp_path)
    (root / "ironbow_lut.json").write_text('{"lut": [[0, 0, 0], [255, 255, 255]]}')
    (root / "other.csv").write_text("0,0,0\n255,0,0\n255,255,255\n")
    assert len(load_capture(root).scales["thermal"].palette.colors) == 2
    other = load_capture(root, spectra=spectra_with(thermal={"palette": str(root / "other.csv")}))
    assert len(other.scales["thermal"].palette.colors) == 3


def test_truncated_image_in_a_capture(tmp_path):
    """A damaged file stops the loading by name."""
    root = write_rgbt_scenes(tmp_path)
    path = root / "rgb" / "train" / "0002.png"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=r"0002\.png is damaged"):
        load_capture(root)
