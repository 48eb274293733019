"""Arrays of undistorted images on the disk."""

from pathlib import Path

import numpy as np
import pytest

from thermosplat.datasets.pixel_cache import PixelCache
from thermosplat.runs import atomic_writes

KEY, OTHER = "0" * 32, "1" * 32
ARRAY = np.arange(24, dtype=np.float32).reshape(4, 6)


@pytest.fixture
def cache(tmp_path: Path) -> PixelCache:
    """One that keeps arrays."""
    found = PixelCache()
    (tmp_path / "pixels").mkdir()
    found.open(tmp_path / "pixels", {KEY})
    return found


def test_arrays_come_back(cache: PixelCache, tmp_path: Path) -> None:
    """As they were; another cache of the same folder has them, too."""
    assert cache.load(KEY, "image") is None
    assert not cache.has(KEY, "image")
    cache.keep(KEY, "image", ARRAY)
    assert cache.has(KEY, "image")
    again = PixelCache()
    again.open(tmp_path / "pixels", {KEY})
    for held in (cache, again):
        np.testing.assert_array_equal(held.load(KEY, "image"), ARRAY, strict=True)


def test_nothing_is_kept_without_a_folder() -> None:
    """Evaluation of a finished run writes nothing."""
    cache = PixelCache()
    cache.keep(KEY, "image", ARRAY)
    assert cache.load(KEY, "image") is None


@pytest.mark.parametrize("left", [0, 50, 150])
def test_what_is_left_of_an_array_is_none(cache: PixelCache, tmp_path: Path, left: int) -> None:
    """A cut file, and one that holds Python objects, are made anew."""
    cache.keep(KEY, "image", ARRAY)
    file = tmp_path / "pixels" / f"{KEY}.image.npy"
    file.write_bytes(file.read_bytes()[:left])
    assert cache.load(KEY, "image") is None
    np.save(file, np.array([{}], dtype=object), allow_pickle=True)
    assert cache.load(KEY, "image") is None


def test_arrays_of_other_settings_are_deleted(cache: PixelCache, tmp_path: Path) -> None:
    """When the folder is opened; files that are not ours stay."""
    cache.keep(KEY, "image", ARRAY)
    (tmp_path / "pixels" / "notes.txt").write_text("mine")
    again = PixelCache()
    again.open(tmp_path / "pixels", {OTHER})
    assert [file.name for file in (tmp_path / "pixels").iterdir()] == ["notes.txt"]


def test_closing_deletes_what_was_kept(cache: PixelCache, tmp_path: Path) -> None:
    """And the folder, if nothing else is in it."""
    cache.keep(KEY, "image", ARRAY)
    cache.close()
    assert not (tmp_path / "pixels").exists()
    cache.close()


def test_a_folder_that_was_moved_is_not_made_again(cache: PixelCache, tmp_path: Path) -> None:
    """Its result folder is elsewhere now, or gone."""
    (tmp_path / "pixels").rename(tmp_path / "elsewhere")
    cache.keep(KEY, "image", ARRAY)
    assert not (tmp_path / "pixels").exists()
    assert cache.load(KEY, "image") is None


def test_a_full_disk_is_no_error(cache: PixelCache, monkeypatch: pytest.MonkeyPatch) -> None:
    """The array is made again when it is needed."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_writes.os, "replace", full)
    cache.keep(KEY, "image", ARRAY)
    assert cache.load(KEY, "image") is None
