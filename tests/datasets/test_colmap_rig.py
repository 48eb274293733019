"""COLMAP models in which the thermal images have cameras of their own."""

import numpy as np
import pytest
from capture_folders import pseudo_color, rgb_image, synthetic_model, temperatures, write_image, write_model

from thermosplat.datasets import load_capture
from thermosplat.errors import UserError

THERMAL_SIZE = (20, 16)


def write_rig(root, count=6, *, base="images", thermal_name=lambda number: f"thermal/{number:04d}.png"):
    """A rig of a 32x24 RGB and a 20x16 thermal camera."""
    model = synthetic_model(count, cameras=2)
    camera = model.cameras[2]
    camera.width, camera.height = THERMAL_SIZE
    camera.params = [30.0, 31.0, 10.0, 8.0]
    for image in model.images.values():
        number = image.frame_id - 1
        if image.camera_id == 2:
            image.name = thermal_name(number)
            write_image(root / base / image.name, pseudo_color(temperatures(number, *THERMAL_SIZE)))
        else:
            write_image(root / base / image.name, rgb_image(number))
    write_model(model, root / "sparse" / "0")
    return model


@pytest.mark.parametrize("base", ["images", "Images", "."])
def test_each_modality_has_its_own_camera_and_pose(tmp_path, base):
    """Intrinsics, size and pose of the thermal views are those of the second sensor; nothing is aligned."""
    model = write_rig(tmp_path, base=base)
    capture = load_capture(tmp_path, test_every=3)
    assert capture.layout == "colmap-rig"
    assert [frame.name for frame in capture.test] == ["0000", "0003"]
    assert len(capture.train) == 4
    assert capture.notes == ()
    for frame in capture.train:
        assert not frame.aligned
        assert (frame.rgb.camera.fx, frame.rgb.camera.width) == (40.0, 32)
        assert (frame.thermal.camera.fx, frame.thermal.camera.width) == (30.0, 20)
        for view, name in ((frame.rgb, f"rgb/{frame.name}.png"), (frame.thermal, f"thermal/{frame.name}.png")):
            image = next(image for image in model.images.values() if image.name == name)
            np.testing.assert_allclose(view.viewmat[:3], image.cam_from_world().matrix(), atol=1e-9)
        assert not np.allclose(frame.rgb.viewmat, frame.thermal.viewmat)
    np.testing.assert_array_equal(capture.train[0].thermal.image, pseudo_color(temperatures(1, *THERMAL_SIZE)))


def test_frames_of_the_rig_pair_images_of_different_names(tmp_path):
    """Vendors number the two cameras apart; the rig's frames know which belong together."""
    write_rig(tmp_path, thermal_name=lambda number: f"thermal/FLIR_{90 - number}.png")
    capture = load_capture(tmp_path)
    frame = capture.train[0]
    assert frame.name == "0001"
    assert frame.thermal.name == "FLIR_89"


def test_without_a_rig_stems_pair(tmp_path):
    """Thermal images registered one by one, each a frame of its own in COLMAP, pair by stem."""
    model = synthetic_model(4, rigs=2)
    for image in model.images.values():
        number = int(image.name[:4]) % 4
        modality = "rgb" if image.camera_id == 1 else "thermal"
        image.name = f"{modality}/{number:04d}.png"
        pixels = rgb_image(number) if modality == "rgb" else pseudo_color(temperatures(number))
        write_image(tmp_path / image.name, pixels)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert capture.layout == "colmap-rig"
    assert len(capture.train) + len(capture.test) == 4
    assert all(frame.rgb is not None and frame.thermal is not None for frame in capture.train)


@pytest.mark.parametrize("rig", [True, False])
@pytest.mark.parametrize("folders", [("train", "test"), ("Train", "Test")])
def test_splits_that_are_numbered_apart(tmp_path, rig, folders):
    """train/0000 and test/0000 are exposures of their own, paired by the rig's frames or by name."""
    model = synthetic_model(4, cameras=2) if rig else synthetic_model(4, rigs=2)
    for image in model.images.values():
        number = (image.frame_id - 1) % 4
        modality = "rgb" if image.camera_id == 1 else "thermal"
        split = folders[number == 3]
        pixels = rgb_image(number) if modality == "rgb" else pseudo_color(temperatures(number))
        image.name = f"{modality}/{split}/{number % 3:04d}.png"
        write_image(tmp_path / image.name, pixels)
    write_model(model, tmp_path / "sparse" / "0")
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.train] == [f"{folders[0]}_000{number}" for number in range(3)]
    assert [frame.name for frame in capture.test] == [f"{folders[1]}_0000"]
    assert capture.notes == ()
    for number, frame in enumerate((*capture.train, *capture.test)):
        np.testing.assert_array_equal(frame.rgb.image, rgb_image(number))
        np.testing.assert_array_equal(frame.thermal.image, pseudo_color(temperatures(number)))


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
    assert next(frame for frame in capture.train if frame.name == "0002").thermal is None
    assert any("1 images of the COLMAP model have no file" in note for note in capture.notes)
    assert any("9999.png" in note for note in capture.notes)
    assert any("1 of 6 RGB images have no thermal partner" in note for note in capture.notes)


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
    for modality in ("rgb", "thermal"):
        (tmp_path / "images" / modality).symlink_to(tmp_path / modality)
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
