"""Plain COLMAP projects with thermal images beside the RGB ones."""

import numpy as np
import pytest

from capture_folders import (
    HEIGHT,
    WIDTH,
    centikelvin,
    pseudo_color,
    rgb_image,
    spectra_with,
    temperatures,
    write_colmap_folder,
    write_image,
)
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError


def add_thermal(root, make, ending="png", count=8):
    for number in range(count):
        write_image(root / "thermal" / f"{number:04d}.{ending}", make(number))


def test_pseudo_color(tmp_path):
    """8-bit colour of the RGB images' size shares their cameras."""
    root = write_colmap_folder(tmp_path)
    add_thermal(root, lambda number: pseudo_color(temperatures(number)))
    capture = load_capture(root, test_every=4)
    assert capture.layout == "colmap"
    assert [frame.name for frame in capture.test] == ["0000", "0004"]
    assert capture.scales["thermal"].kind == "color"
    assert all(frame.aligned for frame in capture.train)


@pytest.mark.parametrize(
    ("ending", "make", "unit"),
    [
        ("png", lambda number: centikelvin(temperatures(number)), "centikelvin"),
        ("tiff", lambda number: (temperatures(number) + 273.15).astype(np.float32), "kelvin"),
        ("tif", lambda number: temperatures(number).astype(np.float32), "celsius"),
    ],
)
def test_radiometric_files_give_the_same_degrees(tmp_path, ending, make, unit):
    """16-bit PNG and float TIFF are judged by their values, or read as the flag says; both give the same °C."""
    root = write_colmap_folder(tmp_path)
    add_thermal(root, make, ending)
    for settings in ({}, {"unit": unit, "range": (0.0, 50.0)}):
        capture = load_capture(root, spectra=spectra_with(thermal=settings))
        assert capture.scales["thermal"].kind == "scalar"
        view = capture.train[0].views["thermal"]
        assert view.image.shape == (HEIGHT, WIDTH, 1)
        np.testing.assert_allclose(view.values, temperatures(1), atol=0.006)
        np.testing.assert_allclose(capture.scales["thermal"].value(view.image[..., 0]), temperatures(1), atol=0.006)
    assert capture.scales["thermal"].range == (0.0, 50.0)


def test_thermal_camera_unknown(tmp_path):
    """Thermal images of another size need a camera, or the word of the user."""
    root = write_colmap_folder(tmp_path)
    add_thermal(root, lambda number: pseudo_color(temperatures(number, 20, 16)))
    with pytest.raises(UserError, match=r"thermal/0000\.png is 20x16.* no thermal camera is in the model") as caught:
        load_capture(root)
    assert "--thermal.aligned" in caught.value.hint
    camera = load_capture(root, spectra=spectra_with(thermal={"aligned": True})).train[0].views["thermal"].camera
    assert (camera.width, camera.height) == (20, 16)
    assert camera.fx == pytest.approx(40 * 20 / WIDTH)
    assert camera.fy == pytest.approx(42 * 16 / HEIGHT)


def test_thermal_cannot_be_read_as_rgb_16bit(tmp_path):
    """16-bit colour thermal files are neither pseudo-colour nor radiometric."""
    root = write_colmap_folder(tmp_path)
    add_thermal(root, lambda number: rgb_image(number).astype(np.uint16) * 257)
    with pytest.raises(UserError, match="uint16 colour"):
        load_capture(root)


def test_rgb_of_16_bits_is_reduced(tmp_path):
    """A 16-bit RGB PNG becomes 8-bit, grey becomes three channels."""
    root = write_colmap_folder(tmp_path)
    write_image(root / "images" / "0001.png", rgb_image(1).astype(np.uint16) * 257)
    write_image(root / "images" / "0002.png", rgb_image(2)[..., 0])
    capture = load_capture(root)
    np.testing.assert_array_equal(capture.train[0].views["rgb"].image, rgb_image(1))
    np.testing.assert_array_equal(capture.train[1].views["rgb"].image[..., 2], rgb_image(2)[..., 0])


def test_a_second_file_of_one_stem_is_the_one_that_is_registered(tmp_path):
    """A copy with another ending neither replaces the image that COLMAP has seen nor takes its pose."""
    root = write_colmap_folder(tmp_path)
    write_image(root / "images" / "0001.tiff", rgb_image(99))  # sorts last
    capture = load_capture(root)
    assert len(capture.train) + len(capture.test) == 8
    np.testing.assert_array_equal(capture.train[0].views["rgb"].image, rgb_image(1))
    assert any("1 images are not in the COLMAP model" in note and "0001.tiff" in note for note in capture.notes)
    add_thermal(root, lambda number: pseudo_color(temperatures(number)))
    with pytest.raises(
        UserError, match=r"0001\.png and 0001\.tiff of images/ have one stem, and 0001\.png of thermal/"
    ):
        load_capture(root)


def test_a_thermal_image_and_its_measurement_in_one_folder(tmp_path):
    """Both have the stem; which to train on is not guessed."""
    root = write_colmap_folder(tmp_path)
    add_thermal(root, lambda number: pseudo_color(temperatures(number)))
    add_thermal(root, lambda number: centikelvin(temperatures(number)), "tiff")
    with pytest.raises(
        UserError, match=r"0000\.png and 0000\.tiff of thermal/ have one stem, and 0000\.png of images/"
    ):
        load_capture(root)


def test_an_unregistered_image_has_no_pose_of_another_folder(tmp_path):
    """images/b/0001 is not registered; images/a/0001, which is, keeps its pose to itself."""
    root = write_colmap_folder(tmp_path)
    write_image(root / "images" / "b" / "0001.png", rgb_image(99))
    capture = load_capture(root)
    assert len(capture.train) + len(capture.test) == 8
    assert any("1 images are not in the COLMAP model" in note for note in capture.notes)


def test_nested_folders_keep_apart_equal_stems(tmp_path):
    """images/left/0000 and images/right/0000 are two frames with names that can be file names."""
    root = write_colmap_folder(tmp_path, 2)
    from capture_folders import synthetic_model, write_model

    model = synthetic_model(2)
    for image, folder in zip(sorted(model.images.values(), key=lambda image: image.name), ("left", "right")):
        image.name = f"{folder}/0000.png"
        write_image(root / "images" / folder / "0000.png", rgb_image(0))
    write_model(model, root / "sparse" / "0")
    capture = load_capture(root)
    assert [frame.name for frame in (*capture.test, *capture.train)] == ["left_0000", "right_0000"]
