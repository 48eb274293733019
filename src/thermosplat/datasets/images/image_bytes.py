"""What the bytes of an image file say before they are decoded: its format, how much memory it takes, its checksums.

A few hundred bytes can claim an image of terabytes, so the header is read first. Sources of the layouts: the PNG and
WebP specifications, ITU-T T.81 (JPEG), TIFF 6.0 and BigTIFF, Microsoft's BITMAPFILEHEADER.
"""

import os
import stat
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, overload

from thermosplat.errors import UserError

LARGEST = 1 << 30
"""Most bytes of an image, in the file and decoded: 350 megapixels of 8-bit colour."""
_RESTORE = "Restore it, or remove it from the folder."
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # without tables and extensions
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Channels that OpenCV gives of each colour type; a palette becomes colours, grey with alpha four channels."""


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says of its pixels.

    Args:
        width: [px].
        height: [px].
        channels: Of the decoded image, at most: 1 for one value per pixel.
        value_bytes: Bytes of a value: 1 for 8 bits and less.
    """

    width: int
    height: int
    channels: int
    value_bytes: int

    @property
    def decoded_bytes(self) -> int:
        """Memory that the decoded image takes [bytes]."""
        return self.width * self.height * self.channels * self.value_bytes

    @property
    def is_radiometric(self) -> bool:
        """The file holds one value of more than 8 bits per pixel."""
        return self.channels == 1 and self.value_bytes > 1


@dataclass(frozen=True)
class FileStamp:
    """What tells a file from another one that takes its place: its size [bytes] and the time of its last change."""

    size: int
    changed_ns: int


def read_header(path: Path) -> tuple[ImageHeader | None, FileStamp]:
    """What a file says of its image, of which little more than the header is read.

    Args:
        path: The file.

    Returns:
        The header, None where the content is no JPEG, PNG, TIFF, BMP or WebP; and the file's stamp.

    Raises:
        UserError: As ``read_regular_file``.
    """
    status = _status(path)
    try:
        with open(path, "rb") as file:
            return image_header(_FileBytes(file, status.st_size)), FileStamp(status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise _unreadable(path, error) from error


def read_regular_file(path: Path) -> bytes:
    """The content of a file.

    Args:
        path: The file.

    Raises:
        UserError: It cannot be read, is larger than ``LARGEST``, or is no regular file (a pipe would never end).
    """
    status = _status(path)
    try:
        with open(path, "rb") as file:
            return file.read(status.st_size)  # no more: room for what is asked for is taken first
    except OSError as error:
        raise _unreadable(path, error) from error


def image_header(content: "Content") -> ImageHeader | None:
    """What the content of a file says of its image; None where it is no JPEG, PNG, TIFF, BMP or WebP.

    Args:
        content: The whole file.
    """
    try:
        for mark, read in _READERS.items():
            if content[: len(mark)] == mark:
                return read(content)
    except (struct.error, IndexError):  # the header is cut off
        pass
    return None


def decoded_bytes(content: bytes) -> int | None:
    """Memory that the decoded image takes [bytes]; None where the content is no JPEG, PNG, TIFF, BMP or WebP.

    Args:
        content: The whole file.
    """
    header = image_header(content)
    return None if header is None else header.decoded_bytes


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


class _FileBytes:
    """A file as bytes that are read where they are looked at."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, key: int) -> int: ...
    @overload
    def __getitem__(self, key: slice) -> bytes: ...
    def __getitem__(self, key: int | slice) -> int | bytes:
        if isinstance(key, int):
            return self[key : key + 1][0]
        start, stop, _ = key.indices(self._size)
        self._file.seek(start)
        return self._file.read(max(stop - start, 0))


Content = bytes | _FileBytes


def _unpacked(layout: str, content: Content, at: int) -> tuple[Any, ...]:
    """Numbers of a ``struct`` layout from a place on.

    Raises:
        struct.error: The content ends before.
    """
    return struct.unpack(layout, content[at : at + struct.calcsize(layout)])


def _png(content: Content) -> ImageHeader | None:
    width, height, depth, color = _unpacked(">IIBB", content, 16)
    return ImageHeader(width, height, _PNG_CHANNELS.get(color, 4), max(1, depth // 8))


def _jpeg(content: Content) -> ImageHeader | None:
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
            depth, height, width, components = _unpacked(">BHHB", content, at + 4)
            return ImageHeader(width, height, 1 if components == 1 else 4, 1 if depth == 8 else 2)
        else:
            at += 2 + _unpacked(">H", content, at + 2)[0]
    return None


def _bmp(content: Content) -> ImageHeader | None:
    (header,) = _unpacked("<I", content, 14)
    width, height = _unpacked("<HH" if header == 12 else "<ii", content, 18)
    return ImageHeader(abs(width), abs(height), 4, 1)


def _webp(content: Content) -> ImageHeader | None:
    kind, at = content[12:16], 20
    if content[8:12] != b"WEBP":
        return None
    if kind == b"VP8X":
        width, height = (int.from_bytes(content[at + k : at + k + 3], "little") + 1 for k in (4, 7))
    elif kind == b"VP8L":
        (packed,) = _unpacked("<I", content, at + 1)
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in _unpacked("<HH", content, at + 6))
    else:
        return None
    return ImageHeader(width, height, 4, 1)


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


def _tiff(content: Content) -> ImageHeader | None:
    """By the tags of the first image; a tile, which is decoded whole, counts where it is larger."""
    tags = _tiff_tags(content)
    if _WIDTH not in tags or _HEIGHT not in tags:
        return None
    width, height = max(tags[_WIDTH], tags.get(_TILE_WIDTH, 0)), max(tags[_HEIGHT], tags.get(_TILE_HEIGHT, 0))
    channels = tags.get(_SAMPLES, 1)
    return ImageHeader(width, height, 1 if channels == 1 else max(channels, 4), max(1, tags.get(_BITS, 1) // 8))


def _tiff_tags(content: Content) -> dict[int, int]:
    """First value of each tag of the first image; 0 where it is no whole number.

    Raises:
        struct.error: The file ends before.
    """
    order = "<" if content[:2] == b"II" else ">"
    (version,) = _unpacked(order + "H", content, 2)
    number, count, size = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    room = struct.calcsize(order + number)
    (at,) = _unpacked(order + number, content, room)
    (entries,) = _unpacked(order + count, content, at)
    at += struct.calcsize(order + count)
    tags: dict[int, int] = {}
    for place in range(at, at + min(entries, _MOST_TIFF_TAGS) * size, size):
        tag, kind = _unpacked(order + "HH", content, place)
        (values,) = _unpacked(order + number, content, place + 4)
        letter = _TIFF_TYPES.get(kind)
        if letter is None:
            tags[tag] = 0
            continue
        value_at = place + 4 + room
        if values * struct.calcsize(letter) > room:  # the values lie elsewhere
            (value_at,) = _unpacked(order + number, content, value_at)
        if value_at <= len(content):
            (tags[tag],) = _unpacked(order + letter, content, value_at)
    return tags


_READERS: dict[bytes, Callable[[Content], ImageHeader | None]] = {
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


def _status(path: Path) -> os.stat_result:
    """Of a file that may be read.

    Raises:
        UserError: It is none.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"Cannot read {path}: it is a {_kind(status.st_mode)}, not a file.", _RESTORE)
    if status.st_size > LARGEST:
        raise UserError(f"{path} has {status.st_size:,} bytes; images have {LARGEST:,} at most.", _RESTORE)
    return status


def _unreadable(path: Path, error: Exception) -> UserError:
    name = str(path) if len(str(path)) <= 300 else f"{str(path)[:300]}..."
    return UserError(f"Cannot read {name}: {getattr(error, 'strerror', None) or error}.")
