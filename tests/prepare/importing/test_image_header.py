"""Sizes of image files without their pixels."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.prepare.importing.image_header import ImageHeader, read_header


@pytest.mark.parametrize(
    ("ending", "dtype", "channels"),
    [
        ("jpg", np.uint8, 3),
        ("jpg", np.uint8, 1),
        ("png", np.uint8, 3),
        ("png", np.uint8, 4),
        ("png", np.uint16, 1),
        ("tiff", np.uint16, 1),
        ("tiff", np.float32, 1),
        ("bmp", np.uint8, 3),
    ],
)
def test_headers_of_all_formats(tmp_path: Path, ending: str, dtype: type, channels: int) -> None:
    """Width, height, channels without alpha, and bits of what OpenCV writes."""
    path = tmp_path / f"a.{ending}"
    assert cv2.imwrite(str(path), np.zeros((6, 8) if channels == 1 else (6, 8, channels), dtype))
    assert read_header(path) == ImageHeader(8, 6, min(channels, 3), 8 * np.dtype(dtype).itemsize)
    assert read_header(path).is_radiometric == (dtype != np.uint8)


def test_damaged_and_missing_files_are_named(tmp_path: Path) -> None:
    """A damaged file and a missing one are errors that name the file."""
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0\x00\x04ab")
    with pytest.raises(UserError, match=r"a.jpg is damaged"):
        read_header(tmp_path / "a.jpg")
    with pytest.raises(UserError, match=r"Cannot read .*b.jpg"):
        read_header(tmp_path / "b.jpg")
