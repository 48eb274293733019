"""A capture whose images stay on the disk is the same one as in memory, and little of it is read at the start."""

from pathlib import Path

import numpy as np
import pytest

from capture_folders import (
    band8,
    centikelvin,
    pseudo_color,
    rgb_image,
    spectra_with,
    synthetic_model,
    temperatures,
    write_image,
    write_model,
    write_rgbt_scenes,
    write_rig,
    write_transforms,
)
from thermosplat.datasets import Capture, large_captures, load_capture
from thermosplat.datasets.images import spectrum_files
from thermosplat.datasets.images.image_files import ImagePixels
from thermosplat.datasets.large_captures import GIGABYTE, allowed_memory
from thermosplat.errors import UserError

NOTHING = 1e-9
"""GB that no image fits into."""


def both(root: Path, **how) -> tuple[Capture, Capture]:
    """A capture in memory, and the same one on the disk."""
    return load_capture(root, **how), load_capture(root, image_memory=NOTHING, **how)


def assert_same(held: Capture, on_disk: Capture) -> None:
    """Frames, cameras, pixels and their meaning are equal to the bit."""
    assert held.on_disk is None
    assert on_disk.on_disk is not None
    assert held.scales == on_disk.scales
    assert held.notes == on_disk.notes[: len(held.notes)]
    for split in ("train", "test"):
        ours, theirs = getattr(held, split), getattr(on_disk, split)
        assert [frame.name for frame in ours] == [frame.name for frame in theirs]
        for one, other in zip(ours, theirs):
            assert list(one.views) == list(other.views)
            for view, unread in zip(one.views.values(), other.views.values()):
                assert unread.image is None
                assert (view.camera, view.channels) == (unread.camera, unread.channels)
                expected, found = view.pixels(), unread.pixels()
                np.testing.assert_array_equal(expected.image, found.image, strict=True)
                assert (expected.values is None) == (found.values is None)
                if expected.values is not None:
                    np.testing.assert_array_equal(expected.values, found.values, strict=True)


@pytest.mark.parametrize(("raw", "source"), [(False, "auto"), (True, "auto"), (True, "raw")])
@pytest.mark.parametrize("data_factor", [1, 2])
def test_pixels_are_those_in_memory(tmp_path: Path, raw: bool, source: str, data_factor: int) -> None:
    """Pseudo-colours and values, whole and shrunk."""
    write_rgbt_scenes(tmp_path, raw=raw)
    assert_same(*both(tmp_path, spectra=spectra_with(thermal={"source": source}), data_factor=data_factor))


def test_other_layouts(tmp_path: Path) -> None:
    """Grey images with a stated range; cameras of several sizes; three spectra."""
    write_transforms(tmp_path / "grey")
    assert_same(*both(tmp_path / "grey"))
    write_rig(tmp_path / "rig", cameras=3)
    assert_same(*both(tmp_path / "rig", spectra=spectra_with(nir={})))


def test_lenses_are_undistorted(tmp_path: Path) -> None:
    """Cameras are known before any image is resampled, and are those of the resampled ones."""
    root = write_rgbt_scenes(tmp_path)
    model = synthetic_model(8, camera_model="OPENCV", params=(40.0, 42.0, 16.0, 12.0, -0.1, 0.02, 0.001, 0.0))
    write_model(model, root / "sparse" / "0")
    held, on_disk = both(root)
    assert_same(held, on_disk)
    assert any("undistorted" in note for note in on_disk.notes)


def test_frames_that_lack_an_image(tmp_path: Path) -> None:
    """What is there is known from names and headers."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    (root / "thermal" / "train" / "0003.png").unlink()
    (root / "thermal_raw" / "0003.png").unlink()
    (root / "thermal_raw" / "0005.png").unlink()
    assert_same(*both(root))


def test_a_note_says_that_images_stay_on_the_disk(tmp_path: Path) -> None:
    """With what they would take, and the flag."""
    write_rgbt_scenes(tmp_path)
    assert load_capture(tmp_path).notes == ()
    (note,) = load_capture(tmp_path, image_memory=NOTHING).notes
    assert note.startswith("The 16 images take 7.37e-05 GB of memory, more than --image-memory allows (1e-09 GB)")
    assert load_capture(tmp_path, image_memory=7.4e-5).on_disk is None


def test_half_of_the_host_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of which processes on other devices take their shares."""
    monkeypatch.setattr(large_captures, "host_memory", lambda: 64 * GIGABYTE)
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    assert allowed_memory(None) == 32 * GIGABYTE
    assert allowed_memory(12.5) == 12.5 * GIGABYTE
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert allowed_memory(None) == 8 * GIGABYTE


def many(root: Path, count: int, *, hot: int | None = None) -> Path:
    """A capture of values alone beside photographs; one frame may be hotter than all others."""
    write_model(synthetic_model(count), root / "sparse" / "0")
    for number in range(count):
        write_image(root / "rgb" / f"{number:04d}.png", rgb_image(number))
        heat = temperatures(number) + (40 if number == hot else 0)
        write_image(root / "thermal" / f"{number:04d}.png", centikelvin(heat))
    return root


def test_few_images_are_read_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of photographs and pseudo-colours a sample; the first image, which may hold the palette, is in it."""
    monkeypatch.setattr(large_captures, "SAMPLED", 3)
    write_rgbt_scenes(tmp_path, 20, folders=False)
    read = []

    def read_pixels(path: Path, usual=spectrum_files.read_pixels) -> ImagePixels:
        read.append(path)
        return usual(path)

    monkeypatch.setattr(spectrum_files, "read_pixels", read_pixels)
    capture = load_capture(tmp_path, image_memory=NOTHING)
    assert sorted(f"{path.parent.name}/{path.stem}" for path in read) == [
        f"{folder}/{number}" for folder in ("rgb", "thermal") for number in ("0000", "0010", "0019")
    ]
    assert len(capture.train) + len(capture.test) == 20


def test_the_range_is_that_of_all_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although a sample says what they are; of very many the range is that of some, and a note says so."""
    monkeypatch.setattr(large_captures, "SAMPLED", 2)
    held, on_disk = both(many(tmp_path, 12, hot=5))
    assert held.scales["thermal"].range[1] > 60
    assert held.scales == on_disk.scales
    monkeypatch.setattr(large_captures, "RANGED_BYTES", 6 * 24 * 32 * 2)
    some = load_capture(tmp_path, image_memory=NOTHING)
    assert some.scales["thermal"].range[1] < 40
    assert any("of the thermal values is that of 6 of 12 images" in note for note in some.notes)
    stated = load_capture(tmp_path, image_memory=NOTHING, spectra=spectra_with(thermal={"range": (0.0, 90.0)}))
    assert len(stated.notes) == len(some.notes) - 1


def test_counts_are_scaled_as_in_memory(tmp_path: Path) -> None:
    """By percentiles of all values."""
    many(tmp_path, 12, hot=5)
    assert_same(*both(tmp_path, spectra=spectra_with(thermal={"unit": "counts"})))


def test_what_is_wrong_with_a_file_is_told_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of files that are not read at the start: damage, and another size than the camera's."""
    monkeypatch.setattr(large_captures, "SAMPLED", 2)
    write_rgbt_scenes(tmp_path, 9, folders=False)
    path = tmp_path / "rgb" / "0005.png"
    write_image(path, rgb_image(5, 32, 32))
    with pytest.raises(UserError, match=r"rgb/0005\.png is 32x32 but its camera was calibrated at 32x24"):
        load_capture(tmp_path, image_memory=NOTHING)
    path.write_bytes(b"no image")
    with pytest.raises(UserError, match=r"rgb/0005\.png is damaged or not an image"):
        load_capture(tmp_path, image_memory=NOTHING)


def test_missing_values_are_told_where_values_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although the frame is in no sample."""
    monkeypatch.setattr(large_captures, "SAMPLED", 2)
    write_rgbt_scenes(tmp_path, 9, folders=False, raw=True)
    (tmp_path / "thermal_raw" / "0005.png").unlink()
    with pytest.raises(UserError, match="frames have no radiometric file"):
        load_capture(tmp_path, image_memory=NOTHING, spectra=spectra_with(thermal={"source": "raw"}))


def test_one_image_of_values_among_pseudo_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no displayable image, and its frame lacks the spectrum, as in memory."""
    monkeypatch.setattr(large_captures, "SAMPLED", 2)
    write_rgbt_scenes(tmp_path, 9, folders=False)
    write_image(tmp_path / "thermal" / "0005.png", centikelvin(temperatures(5)))
    held, on_disk = both(tmp_path)
    assert_same(held, on_disk)
    assert sum("thermal" not in frame.views for frame in (*on_disk.train, *on_disk.test)) == 1


def test_grey_images_on_the_disk(tmp_path: Path) -> None:
    """8-bit values of a further spectrum."""
    write_rgbt_scenes(tmp_path, folders=False)
    for number in range(8):
        write_image(tmp_path / "nir" / f"{number:04d}.png", band8(number))
        write_image(tmp_path / "thermal" / f"{number:04d}.png", pseudo_color(temperatures(number)))
    assert_same(*both(tmp_path, spectra=spectra_with(nir={"source": "auto"})))


def test_images_may_stay_distorted(tmp_path: Path) -> None:
    """Where they are rendered through the lens."""
    root = write_rgbt_scenes(tmp_path)
    model = synthetic_model(8, camera_model="OPENCV", params=(40.0, 42.0, 16.0, 12.0, -0.1, 0.02, 0.001, 0.0))
    write_model(model, root / "sparse" / "0")
    held, on_disk = both(root, lens="direct")
    assert_same(held, on_disk)
    straight = load_capture(root, image_memory=NOTHING)
    assert straight.train[0].views["rgb"].stored.key != on_disk.train[0].views["rgb"].stored.key
