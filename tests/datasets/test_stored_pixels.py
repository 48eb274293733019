"""Pixels on the disk: read once, kept, and missed by name."""

import os
from pathlib import Path

import numpy as np
import pytest

from capture_folders import centikelvin, rgb_image, temperatures, write_image, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.kept_images import forget_images, keep_images
from thermosplat.datasets.read_ahead import read_ahead
from thermosplat.datasets.stored_pixels import ImageLostError, TrainedPixels
from thermosplat.spectra import DEFAULT_SPECTRA


def on_disk(root: Path) -> Capture:
    return load_capture(root, image_memory=1e-9)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Photographs and pseudo-colours with values beside them."""
    return on_disk(write_rgbt_scenes(tmp_path / "shed", folders=False, raw=True))


def test_what_training_takes(capture: Capture) -> None:
    """Bytes, and of pseudo-colours their intensity, as it is found in memory."""
    views = capture.train[0].views
    assert views["rgb"].stored.read_to_train().intensity is None
    image, intensity, _ = views["thermal"].stored.read_to_train()
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(intensity, capture.scales["thermal"].palette.to_intensity(image), strict=True)
    assert views["thermal"].stored.trained_bytes == image.nbytes + intensity.nbytes
    assert views["rgb"].stored.trained_bytes == views["rgb"].pixels().image.nbytes


def test_a_kept_image_outlives_its_file(capture: Capture, tmp_path: Path) -> None:
    """What was read once does not depend on the capture's disk any more."""
    (tmp_path / "run").mkdir()
    assert "until the training ends" in keep_images(capture, tmp_path / "run")[0]
    stored = capture.train[0].views["thermal"].stored
    image, intensity, _ = stored.read_to_train()
    values = stored.read().values
    for path in capture.root.rglob("*.png"):
        path.unlink()
    again = stored.read_to_train()
    np.testing.assert_array_equal(again.image, image, strict=True)
    np.testing.assert_array_equal(again.intensity, intensity, strict=True)
    np.testing.assert_array_equal(stored.read().values, values, strict=True)
    forget_images(capture)
    assert list((tmp_path / "run").iterdir()) == []
    with pytest.raises(ImageLostError, match=r"Cannot read .*0001\.png: No such file"):
        stored.read()


def test_what_is_damaged_on_the_disk_is_made_again(capture: Capture, tmp_path: Path) -> None:
    """After a power cut a kept file may hold zeros, of any part."""
    (tmp_path / "run").mkdir()
    keep_images(capture, tmp_path / "run")
    stored = capture.train[0].views["thermal"].stored
    expected, values = stored.read_to_train(), stored.read().values
    files = sorted((tmp_path / "run" / "pixels").iterdir())
    assert len(files) == 3
    for file in files:
        whole = file.read_bytes()
        file.write_bytes(whole[:200] + bytes(len(whole) - 200))
        image, intensity = np.zeros_like(expected.image), np.zeros_like(expected.intensity)
        stored.read_into(TrainedPixels(image, intensity))
        np.testing.assert_array_equal(image, expected.image)
        np.testing.assert_array_equal(intensity, expected.intensity)
        np.testing.assert_array_equal(stored.read().values, values, strict=True)
        assert file.read_bytes() == whole


def test_an_image_of_another_size(capture: Capture) -> None:
    """It would no longer be its camera's."""
    write_image(capture.root / "rgb" / "0001.png", rgb_image(1, 64, 48))
    with pytest.raises(ImageLostError, match=r"rgb/0001\.png is 64x48, and it was 32x24 when the training began"):
        capture.train[0].views["rgb"].pixels()


def test_an_image_of_another_kind(capture: Capture) -> None:
    """Values in place of a displayable image."""
    write_image(capture.root / "thermal" / "0001.png", centikelvin(temperatures(1)))
    with pytest.raises(ImageLostError, match=r"thermal/0001\.png is no longer of the kind"):
        capture.train[0].views["thermal"].pixels()


def test_a_damaged_image(capture: Capture) -> None:
    """Named as when a capture is read at once."""
    path = capture.root / "rgb" / "0001.png"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ImageLostError, match=r"rgb/0001\.png is damaged or not an image"):
        capture.train[0].views["rgb"].pixels()


def test_the_key_is_of_all_that_decides(capture: Capture) -> None:
    """Files, lens, size and meaning: a file that was replaced is not taken for the one that was kept."""
    keys = {view.stored.key for frame in capture.train for view in frame.views.values()}
    assert len(keys) == 2 * len(capture.train)
    assert {v.stored.key for f in on_disk(capture.root).train for v in f.views.values()} == keys
    smaller = load_capture(capture.root, image_memory=1e-9, data_factor=2)
    assert keys.isdisjoint(view.stored.key for frame in smaller.train for view in frame.views.values())
    path = capture.root / "rgb" / "0001.png"
    os.utime(path, ns=(0, 0))
    assert on_disk(capture.root).train[0].views["rgb"].stored.key not in keys
    by_values = dict(DEFAULT_SPECTRA) | {"thermal": capture.spectra["thermal"].__class__(unit="auto", palette=None)}
    other = load_capture(capture.root, image_memory=1e-9, spectra=by_values)
    assert other.train[0].views["thermal"].stored.key not in keys


def test_no_room_on_the_disk(capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints need some; images are then decoded again, and that is said."""
    (tmp_path / "run").mkdir()
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("thermosplat.datasets.kept_images.shutil.disk_usage", lambda folder: usage)
    (line,) = keep_images(capture, tmp_path / "run")
    assert line.startswith(f"The disk of {tmp_path / 'run'} has no room for the")
    capture.train[0].views["rgb"].pixels()
    assert list((tmp_path / "run").iterdir()) == []
    assert keep_images(load_capture("sample"), tmp_path / "run") == []


def test_frames_are_read_ahead(capture: Capture) -> None:
    """In their order, each whole; those in memory come as they are."""
    held = load_capture(capture.root)
    assert list(read_ahead(held.train)) == list(held.train)
    found = list(read_ahead(capture.train))
    assert [frame.name for frame in found] == [frame.name for frame in held.train]
    for frame, expected in zip(found, held.train):
        for name, view in frame.views.items():
            assert view.stored is None
            np.testing.assert_array_equal(view.image, expected.views[name].image)
    (capture.root / "rgb" / "0003.png").unlink()
    with pytest.raises(ImageLostError, match=r"0003\.png"):
        list(read_ahead(capture.train))


def test_damaged_jpegs_are_looked_for_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where threads share a process, another process decodes the file before."""
    root = write_rgbt_scenes(tmp_path, folders=False)
    capture = on_disk(root)
    asked = []
    monkeypatch.setattr("thermosplat.datasets.stored_pixels.check_jpegs", asked.extend)
    capture.train[0].views["rgb"].stored.check()
    assert asked == [root / "rgb" / "0001.png"]
