"""Damaged lengths inside COLMAP's binary files: told before pycolmap follows them."""

import struct
from pathlib import Path

import pytest

from capture_folders import synthetic_model, write_model
from thermosplat.datasets.colmap.model import read_model
from thermosplat.datasets.colmap.record_lengths import wrong_lengths
from thermosplat.errors import UserError

FILES = ("cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin")
FIRST_DATA_COUNT = 8 + 4 + 4 + 56
FIRST_TRACK_LENGTH = 8 + 8 + 24 + 3 + 8
FIRST_NAME = 8 + 4 + 56 + 4


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model of two cameras on a rig."""
    write_model(synthetic_model(3, cameras=2), tmp_path)
    return tmp_path


def test_whole_models_are_read(model):
    """Rigs with poses, images with points, tracks: every byte belongs to a record."""
    assert wrong_lengths(model) is None
    assert len(read_model(model).images) == 6


def changed(path: Path, at: int, kind: str, difference: int) -> None:
    content = bytearray(path.read_bytes())
    (value,) = struct.unpack_from(kind, content, at)
    struct.pack_into(kind, content, at, value + difference)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "at", "kind", "difference"),
    [
        ("frames.bin", FIRST_DATA_COUNT, "<I", 1 << 30),
        ("points3D.bin", FIRST_TRACK_LENGTH, "<Q", 1 << 30),
        ("points3D.bin", FIRST_TRACK_LENGTH, "<Q", 1 << 40),
        ("points3D.bin", FIRST_TRACK_LENGTH, "<Q", 1),
        ("images.bin", FIRST_NAME + len("rgb/0000.png") + 1, "<Q", 1 << 30),
        ("rigs.bin", 8 + 4, "<I", 1 << 30),
        ("cameras.bin", 0, "<Q", 1 << 40),
        ("points3D.bin", 0, "<Q", -1),
    ],
)
def test_wrong_lengths_are_told(model, name, at, kind, difference):
    """A length that reaches beyond the file, or leaves a rest, names the file at once."""
    changed(model / name, at, kind, difference)
    with pytest.raises(UserError, match=f"{name} is damaged: ") as caught:
        read_model(model)
    assert "record" in caught.value.message or "name" in caught.value.message


@pytest.mark.parametrize("name", FILES)
def test_inserted_bytes_are_told(model, name):
    """64 bytes in the middle shift every length behind them."""
    content = (model / name).read_bytes()
    middle = len(content) // 2
    (model / name).write_bytes(content[:middle] + bytes(64) + content[middle:])
    with pytest.raises(UserError, match=f"{name} is damaged: "):
        read_model(model)


def test_a_name_without_an_end_is_told(model):
    """The name would be read up to the end of the file."""
    path = model / "images.bin"
    content = path.read_bytes()
    path.write_bytes(content[:FIRST_NAME] + b"x" * 5000 + content[FIRST_NAME:])
    with pytest.raises(UserError, match=r"the name of image \d+ does not end"):
        read_model(model)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("size", [0, 5, 10])
def test_files_of_next_to_nothing_are_told(model, name, size):
    """Nothing to map into memory, half a count, a count alone."""
    (model / name).write_bytes((model / name).read_bytes()[:size])
    with pytest.raises(UserError, match=f"{name} is damaged: "):
        read_model(model)
