"""COLMAP models in which the thermal images have cameras of their own."""

import numpy as np
import pytest

from capture_folders import (
    band8,
    band16,
    pseudo_color,
    rgb_image,
    rig_image,
    spectra_with,
    synthetic_model,
    temperatures,
    write_image,
    write_model,
    write_rig,
)
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError


@pytest.mark.parametrize("base", ["images", "Images", "."])
def test_each_spectrum_has_its_own_camera_and_pose(tmp_path, base):
    """Intrinsics, size and pose of the thermal views are those of the second sensor; nothing is aligned."""
    model = write_rig(tmp_path, base=base)
    capture = load_capture(tmp_path, test_every=3)
    assert capture.layout == "colmap-rig"
    assert [frame.name for frame in capture.test] == ["0000", "0003"]
    assert len(capture.train) == 4
    assert capture.notes == ()
    for frame in capture.train:
        assert not frame.aligned
        assert (frame.views["rgb"].camera.fx, frame.views["rgb"].camera.width) == (40.0, 32)
        assert (frame.views["thermal"].camera.fx, frame.views["thermal"].camera.width) == (30.0, 20)
        for spectrum, view in frame.views.items():
            image = next(image for image in model.images.values() if image.name == f"{spectrum}/{frame.name}.png")
            np.testing.assert_allclose(view.viewmat[:3], image.cam_from_world().matrix(), atol=1e-9)
        assert not np.allclose(frame.views["rgb"].viewmat, frame.views["thermal"].viewmat)
    np.testing.assert_array_equal(capture.train[0].views["thermal"].image, rig_image("thermal", 1))


def test_frames_of_the_rig_pair_images_of_different_names(tmp_path):
    """Vendors number the two cameras apart; the rig's frames know which belong together."""
    write_rig(tmp_path, thermal_name=lambda number: f"thermal/FLIR_{90 - number}.png")
    capture = load_capture(tmp_path)
    frame = capture.train[0]
    assert frame.name == "0001"
    assert frame.views["thermal"].name == "FLIR_89"


def test_without_a_rig_stems_pair(tmp_path):
    """Thermal images registered one by one, each a frame of its own in COLMAP, pair by stem."""
    model = synthetic_model(4, rigs=2)
    for image in model.images.values():
        number = int(image.name[:4]) % 4
        spectrum = "rgb" if image.camera_id == 1 else "thermal"
        image.name = f"{spectrum}/{number:04d}.png"
        pixels = rgb_image(number) if spectrum == "rgb" else pseudo_color(temperatures(number))
        write_image(tmp_path / image.name, pixels)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert capture.layout == "colmap-rig"
    assert len(capture.train) + len(capture.test) == 4
    assert all({"rgb", "thermal"} <= frame.views.keys() for frame in capture.train)


@pytest.mark.parametrize("rig", [True, False])
@pytest.mark.parametrize("folders", [("train", "test"), ("Train", "Test")])
def test_splits_that_are_numbered_apart(tmp_path, rig, folders):
    """train/0000 and test/0000 are exposures of their own, paired by the rig's frames or by name."""
    model = synthetic_model(4, cameras=2) if rig else synthetic_model(4, rigs=2)
    for image in model.images.values():
        number = (image.frame_id - 1) % 4
        spectrum = "rgb" if image.camera_id == 1 else "thermal"
        split = folders[number == 3]
        pixels = rgb_image(number) if spectrum == "rgb" else pseudo_color(temperatures(number))
        image.name = f"{spectrum}/{split}/{number % 3:04d}.png"
        write_image(tmp_path / image.name, pixels)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.train] == [f"{folders[0]}_000{number}" for number in range(3)]
    assert [frame.name for frame in capture.test] == [f"{folders[1]}_0000"]
    assert capture.notes == ()
    for number, frame in enumerate((*capture.train, *capture.test)):
        np.testing.assert_array_equal(frame.views["rgb"].image, rgb_image(number))
        np.testing.assert_array_equal(frame.views["thermal"].image, pseudo_color(temperatures(number)))


def test_a_registered_name_of_two_files(tmp_path):
    """rgb/0001.png of the model cannot be both rgb/train/0001.png and rgb/test/0001.png."""
    write_rig(tmp_path, base=".")
    for split in ("train", "test"):
        write_image(tmp_path / "rgb" / split / "0001.png", rgb_image(1))
    assert len(load_capture(tmp_path).train) == 5  # the file of that very name is the one
    (tmp_path / "rgb" / "0001.png").unlink()
    with pytest.raises(
        UserError, match=r"rgb/train/0001\.png and rgb/test/0001\.png of .* rgb/0001\.png of the COLMAP"
    ):
        load_capture(tmp_path)


def test_missing_and_unregistered_files_are_counted(tmp_path):
    """A thermal image without its file leaves the RGB view; an unregistered file is said."""
    write_rig(tmp_path)
    (tmp_path / "images" / "thermal" / "0002.png").unlink()
    write_image(tmp_path / "images" / "rgb" / "9999.png", rgb_image(0))
    capture = load_capture(tmp_path)
    assert list(next(frame for frame in capture.train if frame.name == "0002").views) == ["rgb"]
    assert any("1 images of the COLMAP model have no file" in note for note in capture.notes)
    assert any("9999.png" in note for note in capture.notes)
    assert any("1 of 6 frames have no thermal image (first: 0002)" in note for note in capture.notes)


def test_thermal_file_of_another_aspect(tmp_path):
    """A thermal file that cannot be its camera's is refused, as an RGB one is."""
    write_rig(tmp_path)
    write_image(tmp_path / "images" / "thermal" / "0001.png", pseudo_color(temperatures(1, 16, 16)))
    with pytest.raises(UserError, match=r"0001\.png is 16x16 but its camera was calibrated at 20x16"):
        load_capture(tmp_path)


def test_images_folder_of_links(tmp_path):
    """images/ as COLMAP wants it for a rig, made of links to the folders that there were: every file counts once."""
    write_rig(tmp_path, base=".")
    (tmp_path / "images").mkdir()
    for spectrum in ("rgb", "thermal"):
        (tmp_path / "images" / spectrum).symlink_to(tmp_path / spectrum)
    capture = load_capture(tmp_path)
    assert len(capture.train) == 5
    assert capture.notes == ()


def test_files_under_other_names_than_the_models(tmp_path):
    """Where no file has a registered name, the message says what the files are called."""
    write_rig(tmp_path)
    for path in (tmp_path / "images").rglob("*.png"):
        path.rename(path.with_suffix(".PNG"))
    with pytest.raises(UserError, match=r"12 images are not in the COLMAP model and were left out \(first: 0000\.PNG"):
        load_capture(tmp_path)


THREE = spectra_with(nir={})


def test_three_cameras(tmp_path):
    """A further spectrum that is registered has its own intrinsics, size and pose, whatever the images are called."""
    model = write_rig(tmp_path, cameras=3, thermal_name="thermal/FLIR_{:04d}.png".format)
    capture = load_capture(tmp_path, spectra=THREE)
    assert capture.layout == "colmap-rig"
    assert capture.notes == ()
    assert len(capture.train) == 5
    for frame in capture.train:
        assert list(frame.views) == ["rgb", "thermal", "nir"]
        assert frame.shared_cameras == (("rgb",), ("thermal",), ("nir",))
        nir, number = frame.views["nir"], int(frame.name)
        assert (nir.camera.fx, nir.camera.width, nir.camera.height) == (33.0, 24, 18)
        image = next(image for image in model.images.values() if image.name == f"nir/{number:04d}.png")
        np.testing.assert_allclose(nir.viewmat[:3], image.cam_from_world().matrix(), atol=1e-9)
        np.testing.assert_allclose(nir.image[..., 0], rig_image("nir", number) / 255, atol=1e-6)


def test_a_camera_of_no_spectrum_is_taken_for_the_first(tmp_path):
    """Nothing tells a further RGB camera from a further spectrum that nobody has defined: it is said."""
    write_rig(tmp_path, cameras=3)
    capture = load_capture(tmp_path)
    assert len(capture.train) + len(capture.test) == 12
    (note,) = (note for note in capture.notes if "further spectrum" in note)
    assert note.startswith("6 images of the COLMAP model are taken for RGB images, although they do not lie in rgb/")
    assert "(first: nir/0000.png)" in note


def three_spectra_by_stems(root):
    """Images of three spectra, each registered one by one with the same camera model."""
    model = synthetic_model(4, rigs=3)
    for image in model.images.values():
        number, spectrum = (image.frame_id - 1) % 4, ("rgb", "thermal", "nir")[image.camera_id - 1]
        image.name = f"{spectrum}/{number:04d}.png"
        pixels = {"rgb": rgb_image(number), "thermal": pseudo_color(temperatures(number)), "nir": band8(number)}
        write_image(root / image.name, pixels[spectrum])
    write_model(model, root / "sparse" / "0")


def test_three_spectra_without_a_rig(tmp_path):
    """Stems pair a further spectrum as they pair the usual ones; its values beside it are found."""
    three_spectra_by_stems(tmp_path)
    for number in range(4):
        write_image(tmp_path / "nir_raw" / f"{number:04d}.png", band16(number))
    capture = load_capture(tmp_path, spectra=spectra_with(nir={"unit": "reflectance", "factor": 1e-4}))
    assert capture.layout == "colmap-rig"
    assert capture.notes == ()
    assert [frame.name for frame in (*capture.test, *capture.train)] == ["0000", "0001", "0002", "0003"]
    for frame in capture.train:
        assert list(frame.views) == ["rgb", "thermal", "nir"]
        np.testing.assert_allclose(frame.views["nir"].values, band16(int(frame.name)) * 1e-4, rtol=1e-6)


@pytest.mark.parametrize("registered", [True, False])
def test_a_spectrum_beside_a_rig(tmp_path, registered):
    """Images that are not in the model share the first camera; their size has to show it, or the user says so."""
    write_rig(tmp_path)
    for number in range(6):
        write_image(tmp_path / "nir" / f"{number:04d}.png", band8(number) if registered else band8(number, 16, 12))
    if not registered:
        with pytest.raises(
            UserError, match=r"nir/0000\.png is 16x12, its RGB image 32x24, and no NIR camera"
        ) as caught:
            load_capture(tmp_path, spectra=THREE)
        assert "--nir.aligned" in caught.value.hint
    capture = load_capture(tmp_path, spectra=spectra_with(nir={"aligned": not registered}))
    assert capture.notes == ()
    for frame in capture.train:
        assert list(frame.views) == ["rgb", "thermal", "nir"]
        rgb, nir = frame.views["rgb"], frame.views["nir"]
        assert nir.camera == rgb.camera.resized(*((32, 24) if registered else (16, 12)))
        np.testing.assert_array_equal(nir.viewmat, rgb.viewmat)
        assert frame.shared_cameras[0] == (("rgb", "nir") if registered else ("rgb",))


def test_values_alone_beside_a_rig(tmp_path):
    """nir_raw/ without nir/ will do."""
    write_rig(tmp_path)
    for number in range(6):
        write_image(tmp_path / "nir_raw" / f"{number:04d}.png", band16(number))
    capture = load_capture(tmp_path, spectra=THREE)
    assert all(frame.views["nir"].path.parent.name == "nir_raw" for frame in capture.train)
