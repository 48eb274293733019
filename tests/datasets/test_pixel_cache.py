"""Arrays of undistorted images on the disk."""

from collections.abc import Callable
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


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("shape", [(4, 6), (5, 7, 3), (1, 1, 1)])
def test_arrays_are_read_into_memory_that_is_there(cache: PixelCache, shape: tuple[int, ...], kind: type) -> None:
    """Of the same shape and type; others are left to be made."""
    array = np.random.default_rng(0).integers(0, 256, shape).astype(kind)
    cache.keep(KEY, "image", array[:, ::-1][:, ::-1])
    into = np.zeros((3, *shape), kind)[1]
    assert cache.load_into(KEY, "image", into)
    np.testing.assert_array_equal(into, array)
    np.testing.assert_array_equal(cache.load(KEY, "image"), array, strict=True)
    assert not cache.load_into(KEY, "image", np.zeros((*shape, 2), kind))
    assert not cache.load_into(KEY, "image", np.zeros(shape, np.int8))
    assert not cache.load_into(KEY, "values", into)
    assert not PixelCache().load_into(KEY, "image", into)


def _cut_to(left: int) -> Callable[[bytes], bytes]:
    return lambda content: content[:left]


@pytest.mark.parametrize(
    "damaged",
    [
        *map(_cut_to, (0, 50, 150, 128 + 96 + 7)),
        lambda content: content + b"0",
        lambda content: bytes(len(content)),
        lambda content: content[:160] + bytes(64) + content[224:],
        lambda content: content[:200] + b"?" + content[201:],
        lambda content: content.replace(b"(4, 6)", b"(6, 4)"),
        lambda content: content.replace(b"(4, 6)", b"(9, 9)"),
    ],
    ids=["empty", "header", "numbers", "sum", "longer", "zeros", "a lost block", "a byte", "turned", "another size"],
)
def test_what_is_left_of_an_array_is_none(
    cache: PixelCache, tmp_path: Path, damaged: Callable[[bytes], bytes], request: pytest.FixtureRequest
) -> None:
    """A cut file, and one of which a part never reached the disk, are made anew."""
    cache.keep(KEY, "image", ARRAY)
    file = tmp_path / "pixels" / f"{KEY}.image.npy"
    whole = file.read_bytes()
    assert len(whole) == 128 + ARRAY.nbytes + 8
    file.write_bytes(damaged(whole))
    assert not cache.load_into(KEY, "image", np.empty_like(ARRAY))
    if request.node.callspec.id != "turned":  # who does not know the shape takes the one that is written
        assert cache.load(KEY, "image") is None
    cache.keep(KEY, "image", ARRAY)
    np.testing.assert_array_equal(cache.load(KEY, "image"), ARRAY)


def test_files_of_others_are_none(cache: PixelCache, tmp_path: Path) -> None:
    """One without a sum, one in Fortran's order, one that holds Python objects, one that claims terabytes."""
    file = tmp_path / "pixels" / f"{KEY}.image.npy"
    for array in (ARRAY, np.asfortranarray(ARRAY), np.array([{}], dtype=object)):
        np.save(file, array, allow_pickle=True)
        assert cache.load(KEY, "image") is None
        assert not cache.load_into(KEY, "image", np.empty_like(ARRAY))
    with file.open("wb") as large:
        described = {"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 1 << 20)}
        np.lib.format.write_array_header_1_0(large, described)
        large.write(bytes(100))
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
