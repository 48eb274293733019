"""What image files claim before they are decoded."""

import os
import socket
import struct
import zlib

import cv2
import numpy as np
import pytest

from capture_folders import rgb_image, write_image
from thermosplat.datasets.images.image_bytes import (
    LARGEST,
    FileStamp,
    image_header,
    is_cut_or_changed,
    read_header,
)
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError

GREY16 = np.arange(768, dtype=np.uint16).reshape(24, 32)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize(
    ("suffix", "image", "expected"),
    [
        (".png", rgb_image(0), 24 * 32 * 3),
        (".png", GREY16, 24 * 32 * 2),
        (".jpg", rgb_image(0), 24 * 32 * 4),
        (".jpg", rgb_image(0)[..., 0], 24 * 32),
        (".bmp", rgb_image(0), 24 * 32 * 4),
        (".webp", rgb_image(0), 24 * 32 * 4),
        (".tiff", rgb_image(0), 24 * 32 * 4),
        (".tiff", GREY16.astype(np.float32), 24 * 32 * 4),
    ],
)
def test_memory_is_known_from_the_header(suffix, image, expected):
    """Width, height, channels and depth of every format that is read."""
    assert image_header(encoded(suffix, image)).decoded_bytes == expected


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".tiff"])
def test_a_header_is_read_without_the_pixels(tmp_path, suffix):
    """Size and kind of an image come from the beginning of its file, or where a TIFF has them."""
    path, content = tmp_path / f"a{suffix}", encoded(suffix, rgb_image(0, 320, 240))
    path.write_bytes(content)
    header, stamp = read_header(path)
    assert header == image_header(content)
    assert (header.width, header.height, header.is_radiometric) == (320, 240, False)
    assert stamp == FileStamp(len(content), path.stat().st_mtime_ns)
    if suffix != ".tiff":
        path.write_bytes(content[:2000])
        assert read_header(path)[0] == header


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_radiometric_files_are_known_by_their_header(suffix):
    """One value of more than 8 bits per pixel; 8-bit grey is none."""
    assert image_header(encoded(suffix, GREY16)).is_radiometric
    assert not image_header(encoded(suffix, GREY16.astype(np.uint8))).is_radiometric


def test_no_header_where_there_is_no_image(tmp_path):
    """Another file has a stamp and no header; a folder and a missing file are refused as they are for reading."""
    (tmp_path / "a.png").write_bytes(b"text")
    assert read_header(tmp_path / "a.png")[0] is None
    for path in (tmp_path, tmp_path / "none.png"):
        with pytest.raises(UserError, match="Cannot read"):
            read_header(path)


@pytest.mark.parametrize("quality", [50, 101])
def test_both_kinds_of_webp(quality):
    """Lossy and lossless ones have headers of their own."""
    content = cv2.imencode(".webp", rgb_image(0), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    assert image_header(content).decoded_bytes == 24 * 32 * 4


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_tiffs_of_either_order_and_size(order, big):
    """TIFF and BigTIFF, whose numbers are longer."""
    mark = b"II" if order == "<" else b"MM"
    pointer, count = ("Q", "Q") if big else ("I", "H")
    head = struct.pack(order + ("HHHQ" if big else "HI"), *((43, 8, 0, 16) if big else (42, 8)))
    room = 8 if big else 4
    entries = [
        struct.pack(order + "HH" + pointer, tag, 4, 1) + struct.pack(order + "I", value).ljust(room, b"\0")
        for tag, value in ((256, 7), (257, 5), (258, 32))
    ]
    content = mark + head + struct.pack(order + count, len(entries)) + b"".join(entries)
    assert image_header(content).decoded_bytes == 7 * 5 * 4


@pytest.mark.parametrize("content", [b"", b"BM", b"\x89PNG", b"II*\0", b"\xff\xd8\xff", b"RIFF1234WAVE"])
def test_what_is_no_image(tmp_path, content):
    """Cut headers and other formats are refused, whatever the file's ending."""
    assert image_header(content) is None
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(UserError, match="damaged or not an image"):
        read_image(tmp_path / "a.png")


def test_an_image_of_terabytes(tmp_path):
    """A small file that claims 100,000 x 100,000 pixels is refused by its header."""
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path = tmp_path / "large.png"
    path.write_bytes(png + struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND")))
    with pytest.raises(UserError, match=r"would take 30,000,000,000 bytes of memory"):
        read_image(path)


def test_a_changed_png_is_refused(tmp_path):
    """Every chunk has a checksum: one bit is enough."""
    content = bytearray(encoded(".png", rgb_image(1)))
    assert not is_cut_or_changed(bytes(content))
    for place in (20, len(content) // 2, len(content) - 20):
        changed = bytearray(content)
        changed[place] ^= 1
        assert is_cut_or_changed(bytes(changed))
    (tmp_path / "a.png").write_bytes(changed)
    with pytest.raises(UserError, match="damaged or not an image"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "device"])
def test_what_is_no_file(tmp_path, monkeypatch, kind):
    """A pipe without a writer would be waited for without end."""
    path = tmp_path / "a.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        monkeypatch.chdir(tmp_path)  # a socket's path must be short
        socket.socket(socket.AF_UNIX).bind("a.png")
    with pytest.raises(UserError, match=f"it is a {kind}, not a file"):
        read_image(path)


def test_a_file_of_gigabytes(tmp_path):
    """The size is asked before the content is read."""
    path = tmp_path / "a.png"
    with path.open("wb") as file:
        file.truncate(LARGEST + 1)
    with pytest.raises(UserError, match=r"has 1,073,741,825 bytes; images have 1,073,741,824 at most"):
        read_image(path)


def test_a_name_that_is_too_long(tmp_path):
    """The system's reason, and the begin of the name."""
    with pytest.raises(UserError, match=r"Cannot read .*too long") as caught:
        read_image(tmp_path / ("x" * 5000 + ".png"))
    assert len(caught.value.message) < 500


def test_a_truncated_tiff_is_damaged(tmp_path):
    """As other files are."""
    write_image(tmp_path / "a.tiff", GREY16)
    content = (tmp_path / "a.tiff").read_bytes()
    for share in (0.3, 0.9):
        (tmp_path / "a.tiff").write_bytes(content[: int(len(content) * share)])
        with pytest.raises(UserError, match="damaged or not an image"):
            read_image(tmp_path / "a.tiff")
