"""Folders of images by their names, and what is said where they hold nothing of use."""

import json

import pytest

from capture_folders import (
    centikelvin,
    pseudo_color,
    rgb_image,
    spectra_with,
    temperatures,
    write_colmap_folder,
    write_image,
    write_rgbt_scenes,
    write_transforms,
)
from thermosplat.datasets import load_capture
from thermosplat.datasets.images.image_folders import spectrum_folder
from thermosplat.errors import UserError
from thermosplat.spectra import THERMAL, label


def lacking(root, **further):
    """The error of a capture that lacks one of the spectra that a model is to have: RGB, thermal and those given."""
    spectra = spectra_with(**further)
    with pytest.raises(UserError) as caught:
        load_capture(root, spectra=spectra).require(list(spectra))
    return caught.value


@pytest.mark.parametrize("name", ["ir", "tir", "lwir", "infrared", "Thermal"])
@pytest.mark.parametrize("write", [write_rgbt_scenes, write_colmap_folder, write_transforms])
def test_thermal_folders_of_other_names(tmp_path, name, write):
    """In every layout, with their units.json."""
    write(tmp_path)
    files = (tmp_path / "rgb" if write is write_rgbt_scenes else tmp_path / "images").rglob("*.png")
    for number, path in enumerate(sorted(files)):
        (tmp_path / "thermal" / path.name).unlink(missing_ok=True)
        write_image(tmp_path / name / path.name, centikelvin(temperatures(number)))
    (tmp_path / name / "units.json").write_text(json.dumps({"unit": "counts"}))
    if write is write_transforms:
        content = json.loads((tmp_path / "transforms_thermal.json").read_text())
        for frame in content["frames"]:
            del frame["thermal_file_path"]
        (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    for path in tmp_path.glob("thermal/t*"):
        path.rename(tmp_path / f"empty_{path.name}")
    capture = load_capture(tmp_path)
    assert len(capture.train + capture.test) == 8
    for frame in capture.train + capture.test:
        assert frame.views["thermal"].path.parent.name == name
        assert frame.views["thermal"].values is None  # counts, as units.json says


def test_a_folder_with_images_wins(tmp_path):
    """An empty thermal/ is not taken where ir/ has images; with images in both it is."""
    (tmp_path / "thermal").mkdir()
    write_image(tmp_path / "ir" / "a.png", rgb_image(0))
    assert spectrum_folder(tmp_path, "thermal", THERMAL).name == "ir"
    write_image(tmp_path / "thermal" / "a.png", rgb_image(0))
    assert spectrum_folder(tmp_path, "thermal", THERMAL).name == "thermal"


@pytest.mark.parametrize("name", ["RGB", "Rgb"])
def test_rgb_folders_in_capitals(tmp_path, name):
    """RGB/ is rgb/."""
    (write_rgbt_scenes(tmp_path) / "rgb").rename(tmp_path / name)
    capture = load_capture(tmp_path)
    assert capture.layout == "rgbt-scenes"
    assert all("rgb" in frame.views for frame in capture.train)


def test_images_in_capitals(tmp_path):
    """Images/ is images/: it is not passed over for thermal/."""
    root = write_colmap_folder(tmp_path)
    (root / "images").rename(root / "Images")
    for number in range(8):
        write_image(root / "thermal" / f"{number:04d}.png", pseudo_color(temperatures(number)))
    load_capture(root).require(["rgb", "thermal"])


def test_no_thermal_folder(tmp_path):
    """What there is in its place."""
    error = lacking(write_colmap_folder(tmp_path))
    assert "There is no thermal/ (nor infrared/, ir/, lwir/, tir/). Found: images/ (8 files)" in error.message
    assert error.hint == "Put them into thermal/, or train on RGB alone: --without thermal."


def test_thermal_images_of_other_names(tmp_path):
    """How many there are, and a name of either kind."""
    root = write_colmap_folder(tmp_path)
    for number in range(3):
        write_image(root / "thermal" / f"t_{number}.png", pseudo_color(temperatures(number)))
    error = lacking(root)
    assert "thermal/ holds 3 images (first: thermal/t_0.png)" in error.message
    assert "The other images are called like images/0001.png." in error.message
    assert error.hint.startswith("Give thermal/ images with the names of their RGB images")


def test_an_empty_thermal_folder(tmp_path):
    """Said as such."""
    root = write_colmap_folder(tmp_path)
    (root / "thermal").mkdir()
    assert "thermal/ is empty." in lacking(root).message


def test_images_that_cannot_be_read(tmp_path):
    """images/ of another kind of file."""
    root = write_colmap_folder(tmp_path)
    (root / "images").rename(root / "thermal")
    (root / "images").mkdir()
    (root / "images" / "0000.xyz").write_bytes(b"x")
    assert "images/ holds 1 files and no image (first: images/0000.xyz; read are .bmp .jfif" in lacking(root).message
    (root / "images" / "0000.heic").write_bytes(b"x")
    message = lacking(root).message
    assert f"1 picture of {root}/images is HEIC, which is not read (first: 0000.heic). Convert" in message


def test_no_rgb_folder(tmp_path):
    """What there is in its place."""
    root = write_colmap_folder(tmp_path)
    (root / "images").rename(root / "thermal")
    error = lacking(root)
    assert "There is no rgb/ (nor color/, images/, vis/, visible/). Found: sparse/ (5 files), thermal/ (8 files)." in (
        error.message
    )
    assert error.hint.endswith("or train on thermal alone: --without rgb.")


@pytest.mark.parametrize(("key", "spectrum"), [("file_path", "rgb"), ("thermal_file_path", "thermal")])
def test_paths_of_a_transforms_file(tmp_path, key, spectrum):
    """The path that was tried, absolute or not."""
    content = write_transforms(tmp_path)
    for number, frame in enumerate(content["frames"]):
        (tmp_path / frame[key]).unlink()
        frame[key] = f"/nowhere/{number}.png"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    error = lacking(tmp_path)
    assert f"has no {label(spectrum)} images" in error.message
    assert "first looked for: /nowhere/0.png" in error.message
    assert error.hint.startswith("Correct the paths")


def test_only_held_out_frames_have_it(tmp_path):
    """The folder is right, the division is not."""
    root = write_rgbt_scenes(tmp_path)
    for path in (root / "thermal" / "train").iterdir():
        path.unlink()
    assert "2 held-out frames have one." in lacking(root).message
