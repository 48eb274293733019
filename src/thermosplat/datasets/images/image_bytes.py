"""What the bytes of an image file say before they are decoded: its format, how much memory it takes, its checksums.

A few hundred bytes can claim an image of terabytes, so the header is read first. Sources of the layouts: the PNG and
WebP specifications, ITU-T T.81 (JPEG), TIFF 6.0 and BigTIFF, Microsoft's BITMAPFILEHEADER.
"""

import os
import stat
import struct
import zlib
from pathlib import Path

from thermosplat.errors import UserError

LARGEST = 1 << 30
"""Most bytes of an image, in the file and decoded: 350 megapixels of 8-bit colour."""
_RESTORE = "Restore it, or remove it from the folder."
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # without tables and extensions
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Channels that OpenCV gives of each colour type; a palette becomes colours, grey with alpha four channels."""


def read_regular_file(path: Path) -> bytes:
    """The content of a file.

    Args:
        path: The file.

    Raises:
        UserError: It cannot be read, is larger than ``LARGEST``, or is no regular file (a pipe would never end).
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"Cannot read {path}: it is a {_kind(status.st_mode)}, not a file.", _RESTORE)
        if status.st_size > LARGEST:
            raise UserError(f"{path} has {status.st_size:,} bytes; images have {LARGEST:,} at most.", _RESTORE)
        with open(path, "rb") as file:
            return file.read(status.st_size)  # no more: room for what is asked for is taken first
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        name = str(path) if len(str(path)) <= 300 else f"{str(path)[:300]}..."
        raise UserError(f"Cannot read {name}: {getattr(error, 'strerror', None) or error}.") from error


def decoded_bytes(content: bytes) -> int | None:
    """Memory that the decoded image takes [bytes]; None where the content is no JPEG, PNG, TIFF, BMP or WebP.

    Args:
        content: The whole file.
    """
    try:
        for mark, read in _READERS.items():
            if content.startswith(mark):
                return read(content)
    except struct.error:  # the header is cut off
        pass
    return None


def is_cut_or_changed(content: bytes) -> bool:
    """Whether a JPEG lacks its end mark, or a PNG its end or the right checksum of a part.

    Args:
        content: The whole file.
    """
    if content.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in content
    if content.startswith(b"\x89PNG"):
        return not _png_is_whole(content)
    return False


def _png_is_whole(content: bytes) -> bool:
    """Every chunk up to the end has the checksum that it states."""
    view, at = memoryview(content), 8
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        end = at + 8 + length
        if end + 4 > len(content) or zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", content, end)[0]:
            return False
        if content[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def _png(content: bytes) -> int | None:
    width, height, depth, color = struct.unpack_from(">IIBB", content, 16)
    return width * height * _PNG_CHANNELS.get(color, 4) * max(1, depth // 8)


def _jpeg(content: bytes) -> int | None:
    at = 2
    while at + 4 <= len(content):
        if content[at] != 0xFF:
            return None
        marker = content[at + 1]
        if marker == 0xFF:  # filling
            at += 1
        elif marker in _WITHOUT_LENGTH:
            at += 2
        elif marker in _START_OF_FRAME:
            depth, height, width, components = struct.unpack_from(">BHHB", content, at + 4)
            return width * height * (1 if components == 1 else 4) * (1 if depth == 8 else 2)
        else:
            at += 2 + struct.unpack_from(">H", content, at + 2)[0]
    return None


def _bmp(content: bytes) -> int | None:
    (header,) = struct.unpack_from("<I", content, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", content, 18)
    return abs(width * height) * 4


def _webp(content: bytes) -> int | None:
    kind, at = content[12:16], 20
    if content[8:12] != b"WEBP":
        return None
    if kind == b"VP8X":
        width, height = (int.from_bytes(content[at + k : at + k + 3], "little") + 1 for k in (4, 7))
    elif kind == b"VP8L":
        (packed,) = struct.unpack_from("<I", content, at + 1)
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", content, at + 6))
    else:
        return None
    return width * height * 4


_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_TIFF_TAGS = 4096
_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 262, 277, 322, 323


def lacks_photometric_tag(content: bytes) -> bool:
    """Whether this is a TIFF that does not say what its values are, which OpenCV 5 refuses (Workswell cameras).

    Args:
        content: The whole file.
    """
    try:
        return content.startswith((b"II*\0", b"MM\0*")) and _PHOTOMETRIC not in _tiff_tags(content)
    except struct.error:
        return False


def _tiff(content: bytes) -> int | None:
    """By the tags of the first image; a tile, which is decoded whole, counts where it is larger."""
    tags = _tiff_tags(content)
    if _WIDTH not in tags or _HEIGHT not in tags:
        return None
    width, height = max(tags[_WIDTH], tags.get(_TILE_WIDTH, 0)), max(tags[_HEIGHT], tags.get(_TILE_HEIGHT, 0))
    channels = tags.get(_SAMPLES, 1)
    return width * height * (1 if channels == 1 else max(channels, 4)) * max(1, tags.get(_BITS, 1) // 8)


def _tiff_tags(content: bytes) -> dict[int, int]:
    """First value of each tag of the first image; 0 where it is no whole number.

    Raises:
        struct.error: The file ends before.
    """
    order = "<" if content.startswith(b"II") else ">"
    (version,) = struct.unpack_from(order + "H", content, 2)
    number, count, size = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    room = struct.calcsize(order + number)
    (at,) = struct.unpack_from(order + number, content, room)
    (entries,) = struct.unpack_from(order + count, content, at)
    at += struct.calcsize(order + count)
    tags: dict[int, int] = {}
    for place in range(at, at + min(entries, _MOST_TIFF_TAGS) * size, size):
        tag, kind = struct.unpack_from(order + "HH", content, place)
        (values,) = struct.unpack_from(order + number, content, place + 4)
        letter = _TIFF_TYPES.get(kind)
        if letter is None:
            tags[tag] = 0
            continue
        value_at = place + 4 + room
        if values * struct.calcsize(letter) > room:  # the values lie elsewhere
            (value_at,) = struct.unpack_from(order + number, content, value_at)
        if value_at <= len(content):
            (tags[tag],) = struct.unpack_from(order + letter, content, value_at)
    return tags


_READERS = {
    b"\xff\xd8": _jpeg,
    b"\x89PNG\r\n\x1a\n": _png,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"BM": _bmp,
    b"RIFF": _webp,
}


def _kind(mode: int) -> str:
    kinds = (("pipe", stat.S_ISFIFO), ("folder", stat.S_ISDIR), ("socket", stat.S_ISSOCK))
    return next((name for name, is_kind in kinds if is_kind(mode)), "device")
