"""Spectra beyond RGB and thermal in every layout: their folders, values, units, cameras, and what is missing."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_folders import (
    HEIGHT,
    WIDTH,
    band8,
    band16,
    pseudo_color,
    reflectances,
    rgb_image,
    spectra_with,
    synthetic_model,
    temperatures,
    write_colmap_folder,
    write_image,
    write_model,
    write_rgbt_scenes,
    write_rig,
    write_transforms,
)
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.errors import UserError
from thermosplat.spectra import RGB, THERMAL, SpectrumConfig

REFLECTANCE = {"unit": "reflectance", "factor": 1e-4}
LAYOUTS: dict[str, Callable[[Path], Any]] = {
    "rgbt-scenes": write_rgbt_scenes,
    "colmap": write_colmap_folder,
    "colmap-rig": write_rig,
    "transforms": write_transforms,
}
IMAGES = {"rgbt-scenes": "rgb", "colmap": "images", "colmap-rig": "images/rgb", "transforms": "images"}
"""Folder of the RGB images."""

every_layout = pytest.mark.parametrize("layout", LAYOUTS)


def number_of(name: str) -> int:
    return int(name[-4:])


def write_capture(root: Path, layout: str) -> Path:
    root.mkdir(exist_ok=True)
    LAYOUTS[layout](root)
    return root


def write_band(root: Path, layout: str, make: Callable[[int], np.ndarray], folder: str = "nir") -> None:
    """An image for each RGB image, under its name, in a folder of its own."""
    base = root / IMAGES[layout]
    for path in sorted(base.rglob("*.png")):
        write_image(root / folder / path.relative_to(base), make(number_of(path.stem)))


def frames_of(capture: Capture) -> tuple[Frame, ...]:
    return (*capture.train, *capture.test)


@every_layout
def test_8_bit_images(tmp_path: Path, layout: str) -> None:
    """Level / 255 is the intensity; without a unit nothing is measured; camera and pose are the RGB image's."""
    write_band(write_capture(tmp_path, layout), layout, band8)
    before, capture = load_capture(tmp_path), load_capture(tmp_path, spectra=spectra_with(nir={}))
    assert capture.layout == layout
    assert capture.notes == before.notes
    assert list(capture.spectra) == ["rgb", "thermal", "nir"]
    scale = capture.scales["nir"]
    assert (scale.kind, scale.range, scale.unit, scale.measured_unit) == ("scalar", None, None, None)
    assert [frame.name for frame in frames_of(capture)] == [frame.name for frame in frames_of(before)]
    for frame in frames_of(capture):
        rgb, nir = frame.views["rgb"], frame.views["nir"]
        assert next(reversed(frame.views)) == "nir"
        assert nir.values is None
        assert (nir.image.shape, nir.image.dtype) == ((HEIGHT, WIDTH, 1), np.float32)
        np.testing.assert_allclose(nir.image[..., 0], band8(number_of(nir.name)) / 255, atol=1e-6)
        assert nir.camera == rgb.camera
        np.testing.assert_array_equal(nir.viewmat, rgb.viewmat)
        assert {"rgb", "nir"} <= set(frame.shared_cameras[0])


@every_layout
@pytest.mark.parametrize("folder", ["nir", "nir_raw"])
def test_16_bit_images(tmp_path: Path, layout: str, folder: str) -> None:
    """Values times the factor, in the unit; 0 and 1 of the image are the capture's extremes, or the stated range."""
    write_band(write_capture(tmp_path, layout), layout, band16, folder)
    capture = load_capture(tmp_path, spectra=spectra_with(nir=REFLECTANCE))
    scale = capture.scales["nir"]
    assert (scale.kind, scale.unit, scale.measured_unit) == ("scalar", "reflectance", "reflectance")
    held = [band16(number_of(frame.views["nir"].name)) * 1e-4 for frame in frames_of(capture)]
    assert scale.range == pytest.approx((np.min(held), np.max(held)))
    for frame, expected in zip(frames_of(capture), held, strict=True):
        nir = frame.views["nir"]
        np.testing.assert_allclose(nir.values, expected, atol=1e-6)
        np.testing.assert_allclose(scale.value(nir.image[..., 0]), expected, atol=1e-6)
    capture = load_capture(tmp_path, spectra=spectra_with(nir={**REFLECTANCE, "range": (0.25, 0.75)}))
    assert capture.scales["nir"].range == (0.25, 0.75)
    for frame, expected in zip(frames_of(capture), held, strict=True):
        clipped = np.clip((expected - 0.25) / 0.5, 0, 1)
        np.testing.assert_allclose(frame.views["nir"].image[..., 0], clipped, atol=1e-6)
        np.testing.assert_allclose(frame.views["nir"].values, expected, atol=1e-6)


@every_layout
def test_8_bit_images_with_values_beside(tmp_path: Path, layout: str) -> None:
    """Sixteen bits in nir_raw/ are what is measured; which of both is trained on is the source."""
    write_band(write_capture(tmp_path, layout), layout, lambda number: 255 - band8(number))
    write_band(tmp_path, layout, band16, "nir_raw")
    shown = load_capture(tmp_path, spectra=spectra_with(nir={**REFLECTANCE, "source": "auto"}))
    values = load_capture(tmp_path, spectra=spectra_with(nir=REFLECTANCE))
    for frame, same in zip(frames_of(shown), frames_of(values), strict=True):
        number = number_of(frame.views["nir"].name)
        np.testing.assert_allclose(frame.views["nir"].image[..., 0], 1 - band8(number) / 255, atol=1e-6)
        np.testing.assert_allclose(same.views["nir"].image[..., 0], reflectances(number), atol=0.02)
        for view in (frame.views["nir"], same.views["nir"]):
            np.testing.assert_allclose(view.values, band16(number) * 1e-4, atol=1e-6)


@every_layout
def test_without_the_images(tmp_path: Path, layout: str) -> None:
    """The capture loads; a model that asks for them is told where they are looked for."""
    capture = load_capture(write_capture(tmp_path, layout), spectra=spectra_with(nir={}))
    assert "nir" not in capture.scales
    assert not any("nir" in frame.views for frame in frames_of(capture))
    assert capture.notes == load_capture(tmp_path).notes
    with pytest.raises(UserError, match=r"has no NIR images with a camera to train on.* There is no nir/\.") as caught:
        capture.require(["rgb", "nir"])
    assert caught.value.hint == "Put them into nir/, or train on RGB alone: --without nir."


@every_layout
def test_some_images_are_missing(tmp_path: Path, layout: str) -> None:
    """Their frames are trained on what they have; a note counts them."""
    write_band(write_capture(tmp_path, layout), layout, band8)
    spectra = spectra_with(nir={})
    whole = load_capture(tmp_path, spectra=spectra)
    for frame in whole.train[1:3]:
        frame.views["nir"].path.unlink()
    capture = load_capture(tmp_path, spectra=spectra)
    assert ["nir" in frame.views for frame in capture.train[:4]] == [True, False, False, True]
    others = "RGB alone" if layout == "colmap" else "RGB and thermal alone"
    name, count = capture.train[1].name, len(frames_of(capture))
    expected = f"2 of {count} frames have no NIR image (first: {name}); they are trained on {others}."
    assert any(note.startswith(expected) for note in capture.notes)


@every_layout
def test_folders_of_other_names(tmp_path: Path, layout: str) -> None:
    """The names that the spectrum states, in any case; the first of them names the folder of values."""
    write_band(write_capture(tmp_path, layout), layout, band8, "Near_Infrared")
    write_band(tmp_path, layout, band16, "band5_raw")
    settings = {**REFLECTANCE, "folders": ("Band5", "near_infrared"), "source": "auto"}
    for frame in frames_of(load_capture(tmp_path, spectra=spectra_with(nir=settings))):
        assert "Near_Infrared" in frame.views["nir"].path.parts
        expected = band16(number_of(frame.views["nir"].name)) * 1e-4
        np.testing.assert_allclose(frame.views["nir"].values, expected, atol=1e-6)


@every_layout
def test_two_further_spectra(tmp_path: Path, layout: str) -> None:
    """Each has its own images, in the order of the configuration, whatever the order of their folders."""
    write_band(write_capture(tmp_path, layout), layout, band8, "red_edge")
    write_band(tmp_path, layout, lambda number: 255 - band8(number), "nir")
    for frame in frames_of(load_capture(tmp_path, spectra=spectra_with(red_edge={}, nir={}))):
        assert list(frame.views)[-2:] == ["red_edge", "nir"]
        np.testing.assert_allclose(frame.views["red_edge"].image + frame.views["nir"].image, 1, atol=1e-6)


@every_layout
def test_a_second_photograph(tmp_path: Path, layout: str) -> None:
    """A spectrum of colours keeps them, without a unit; grey files become colours."""
    write_band(write_capture(tmp_path, layout), layout, lambda number: rgb_image(90 + number), "zoom")
    capture = load_capture(tmp_path, spectra=spectra_with(zoom={"source": "photograph"}))
    assert (capture.scales["zoom"].kind, capture.scales["zoom"].channels) == ("photograph", 3)
    for frame in frames_of(capture):
        view = frame.views["zoom"]
        np.testing.assert_array_equal(view.image, rgb_image(90 + number_of(view.name)))
        assert frame_tensors(frame, capture.scales, "cpu").views["zoom"].intensity is None


def test_distortion_and_size_are_those_of_the_first(tmp_path: Path) -> None:
    """A borrowed camera is undistorted and shrunk like its lender's, values too."""
    root = write_rgbt_scenes(tmp_path)
    write_model(synthetic_model(8, camera_model="SIMPLE_RADIAL", params=(40.0, 16.0, 12.0, 0.1)), root / "sparse" / "0")
    write_band(root, "rgbt-scenes", band16)
    capture = load_capture(root, data_factor=2, spectra=spectra_with(nir=REFLECTANCE))
    assert sum("SIMPLE_RADIAL" in note for note in capture.notes) == 1
    for frame in capture.train:
        assert frame.aligned
        nir = frame.views["nir"]
        assert nir.image.shape[:2] == nir.values.shape == frame.views["rgb"].image.shape[:2]
        assert nir.values.shape != (HEIGHT // 2, WIDTH // 2)


def test_another_size_needs_a_camera(tmp_path: Path) -> None:
    """In a plain project, where nothing promises that images are registered, both sizes and the flag are named."""
    write_band(write_capture(tmp_path, "colmap"), "colmap", lambda number: band8(number, 20, 16))
    expected = r"nir/0000\.png is 20x16, its RGB image 32x24, and no NIR camera is in the model or its rig"
    with pytest.raises(UserError, match=expected) as caught:
        load_capture(tmp_path, spectra=spectra_with(nir={}))
    assert "If the NIR images are registered to the RGB ones: --nir.aligned" in caught.value.hint
    frame = load_capture(tmp_path, spectra=spectra_with(nir={"aligned": True})).train[0]
    assert (frame.views["nir"].camera.width, frame.views["nir"].camera.height) == (20, 16)
    assert frame.shared_cameras == (("rgb",), ("nir",))


@pytest.mark.parametrize("folder", ["nir", "."])
def test_no_photographs_at_all(tmp_path: Path, folder: str) -> None:
    """A capture of NIR and thermal images, of which COLMAP has seen the NIR ones: both share that camera."""
    root = write_rgbt_scenes(tmp_path, folders=False)
    write_band(root, "rgbt-scenes", band8)
    shutil.rmtree(root / "rgb")
    model = synthetic_model(8)
    for image in model.images.values():
        image.name = str(Path(folder) / image.name)
    write_model(model, root / "sparse" / "0")
    capture = load_capture(root, spectra=spectra_with(nir={}))
    assert len(capture.train) == 7
    capture.require(["thermal", "nir"])
    assert all(frame.shared_cameras == (("thermal", "nir"),) for frame in capture.train)


@pytest.mark.parametrize("divided", [True, False])
def test_equal_stems_in_both_splits(tmp_path: Path, divided: bool) -> None:
    """Images of a further spectrum alone, registered below its folder, are told apart by train/ and test/."""
    model = synthetic_model(4)
    for number, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        split, stem = ("test", 0) if number == 3 else ("train", number)
        image.name = f"nir/{split}/{stem:04d}.png"
        write_image(tmp_path / "nir" / (split if divided else "") / f"{stem:04d}.png", band8(number))
    write_model(model, tmp_path / "sparse" / "0")
    spectra = spectra_with(nir={})
    if not divided:
        with pytest.raises(UserError, match="have one stem"):
            load_capture(tmp_path, spectra=spectra)
        return
    capture = load_capture(tmp_path, spectra=spectra)
    assert [frame.name for frame in capture.train] == ["train_0000", "train_0001", "train_0002"]
    assert [frame.name for frame in capture.test] == ["test_0000"]
    np.testing.assert_allclose(capture.test[0].views["nir"].image[..., 0], band8(3) / 255, atol=1e-6)


def test_files_that_a_transforms_file_names(tmp_path: Path) -> None:
    """nir_file_path of a frame wins over the folder; what it names in vain is counted and made up for by the folder."""
    content = write_transforms(tmp_path)
    write_band(tmp_path, "transforms", lambda number: 255 - band8(number))
    for number, frame in enumerate(content["frames"]):
        frame["nir_file_path"] = f"bands/{number:04d}.png"
        if number not in (2, 3):
            write_image(tmp_path / frame["nir_file_path"], band8(number))
    (tmp_path / "nir" / "frame_train_00003.png").unlink()
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path, spectra=spectra_with(nir={}))
    for frame in frames_of(capture):
        number = int(frame.name[-1])
        if number == 3:
            assert "nir" not in frame.views
            continue
        expected = 255 - band8(number) if number == 2 else band8(number)
        np.testing.assert_allclose(frame.views["nir"].image[..., 0], expected / 255, atol=1e-6)
    lost = tmp_path / "bands" / "0002.png"
    assert (
        f"nir_file_path of 2 of 8 frames of transforms_thermal.json names no file (first: {lost}). "
        "1 of them have a NIR image of their own name, which was taken."
    ) in capture.notes


def test_a_transforms_file_that_names_nothing_that_exists(tmp_path: Path) -> None:
    """The path that was tried is in the error of the model that asks for the spectrum."""
    content = write_transforms(tmp_path)
    for frame in content["frames"]:
        frame["nir_file_path"] = "/nowhere/0.png"
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"that it names for them do not exist .*/nowhere/0\.png") as caught:
        load_capture(tmp_path, spectra=spectra_with(nir={})).require(["rgb", "nir"])
    assert caught.value.hint.startswith("Correct the paths")


def test_a_transforms_file_of_further_spectra_alone(tmp_path: Path) -> None:
    """Frames are called by the first spectrum that they name; the thermal images of their stems are found."""
    content = write_transforms(tmp_path)
    for frame in content["frames"]:
        frame["nir_file_path"] = frame.pop("file_path").replace("images/", "nir/")
        del frame["thermal_file_path"]
    (tmp_path / "images").rename(tmp_path / "nir")
    for path in (tmp_path / "nir").iterdir():
        write_image(path, band8(int(path.stem[-1])))
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path, spectra=spectra_with(nir={}))
    assert [frame.name for frame in capture.test] == ["frame_eval_00000", "frame_eval_00004"]
    assert all(list(frame.views) == ["thermal", "nir"] for frame in frames_of(capture))


def test_the_first_spectrum_may_be_another(tmp_path: Path) -> None:
    """Whichever comes first has the registered images, in the folder of its name or in images/."""
    root = write_rgbt_scenes(tmp_path / "a", folders=False)
    capture = load_capture(root, spectra={"thermal": THERMAL, "rgb": RGB})
    assert capture.layout == "rgbt-scenes"
    for frame in capture.train:
        assert list(frame.views) == ["thermal", "rgb"]
        np.testing.assert_array_equal(frame.views["thermal"].image, pseudo_color(temperatures(int(frame.name))))
        np.testing.assert_array_equal(frame.views["rgb"].image, rgb_image(int(frame.name)))
    root = write_colmap_folder(tmp_path / "b")
    grey = load_capture(root, spectra={"pan": SpectrumConfig(source="photograph")})
    assert grey.layout == "colmap"
    assert all(list(frame.views) == ["pan"] for frame in grey.train)


def test_an_unknown_layout_names_the_folders_of_all_spectra(tmp_path: Path) -> None:
    """What was looked for is listed, of one spectrum as of three."""
    with pytest.raises(UserError, match=r"Looked for rgb/, thermal/ and nir/, images/, thermal/ and nir/, and trans"):
        load_capture(tmp_path, spectra=spectra_with(nir={}))
    with pytest.raises(
        UserError, match=r"Looked for pan/, images/, and transforms_thermal\.json or transforms\.json\."
    ):
        load_capture(tmp_path, spectra={"pan": SpectrumConfig()})
