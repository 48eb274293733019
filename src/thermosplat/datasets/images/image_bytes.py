"""What the bytes of an image file say before they are decoded: its format, how much memory it takes, its checksums.

A few hundred bytes can claim an image of terabytes, so the header is read first. Sources of the layouts: the PNG and
WebP specifications, ITU-T T.81 (JPEG), TIFF 6.0 and BigTIFF, Microsoft's BITMAPFILEHEADER.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from thermosplat.datasets.images.file_content import Content, FileBytes, unpacked
from thermosplat.datasets.images.tiff_tags import read_tiff_tags
from thermosplat.errors import UserError
from thermosplat.regular_files import open_regular

LARGEST = 1 << 30
"""Most bytes of an image, in the file and decoded: 350 megapixels of 8-bit colour."""
_RESTORE = "Restore it, or remove it from the folder."
TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""What TIFF and BigTIFF files begin with."""
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # without tables and extensions
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
"""Channels that OpenCV gives of each colour type; a palette becomes colours, grey with alpha four channels."""
_PNG_GREY, _PNG_ALPHA = (0, 4), (4, 6)


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says of its pixels.

    Args:
        width: [px].
        height: [px].
        channels: Of the image without its alpha: 1 for one value per pixel, else 3.
        value_bytes: Bytes of a value: 1 for 8 bits and less.
        decoded_bytes: Memory that decoding takes, with alpha and what is cut off [bytes].
        has_alpha: The file says, or may say, of pixels that there is nothing.
    """

    width: int
    height: int
    channels: int
    value_bytes: int
    decoded_bytes: int
    has_alpha: bool = False

    @classmethod
    def of(
        cls, width: int, height: int, channels: int, samples: int, value_bytes: int = 1, *, has_alpha: bool = False
    ) -> "ImageHeader":
        """Of an image that is decoded to so many samples a pixel."""
        return cls(width, height, channels, value_bytes, width * height * samples * value_bytes, has_alpha)

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

    Returns:
        The header, None where the content is no JPEG, PNG, TIFF, BMP or WebP; and the file's stamp.

    Raises:
        UserError: As ``read_regular_file``.
    """
    try:
        with open_regular(path) as file:
            status = _status(path, file)
            return image_header(FileBytes(file, status.st_size)), FileStamp(status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise _unreadable(path, error) from error


def read_regular_file(path: Path) -> bytes:
    """The content of a file.

    Raises:
        UserError: It cannot be read, is larger than ``LARGEST``, or is no regular file (a pipe would never end).
    """
    try:
        with open_regular(path) as file:
            return file.read(_status(path, file).st_size)  # no more: room for what is asked for is taken first
    except OSError as error:
        raise _unreadable(path, error) from error


def image_header(content: Content) -> ImageHeader | None:
    """What the content of a file says of its image; None where it is no JPEG, PNG, TIFF, BMP or WebP."""
    try:
        for mark, read in _READERS.items():
            if content[: len(mark)] == mark:
                return read(content)
    except (struct.error, IndexError):  # the header is cut off
        pass
    return None


def is_cut_or_changed(content: bytes) -> bool:
    """Whether a JPEG lacks its end mark, or a PNG its end or the right checksum of a part."""
    if content.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in content
    if content.startswith(b"\x89PNG"):
        return not _png_is_whole(content)
    return False


def is_grey16_with_alpha(content: bytes) -> bool:
    """Whether this is a PNG whose 16-bit grey has an alpha channel."""
    return content.startswith(b"\x89PNG") and content[24:26] == b"\x10\x04"


def transparent_level(content: bytes) -> int | None:
    """The level that a grey PNG says is transparent, as it is decoded; None where there is none.

    Args:
        content: The whole file, whose chunks are whole.
    """
    if not content.startswith(b"\x89PNG") or content[25] != 0:
        return None
    for kind, begin, _ in _png_chunks(content):
        if kind == b"IDAT":
            break
        if kind == b"tRNS":
            depth, level = content[24], int.from_bytes(content[begin : begin + 2], "big")
            return level if depth == 16 else (level & (1 << depth) - 1) * 255 // ((1 << depth) - 1)
    return None


def _png_is_whole(content: bytes) -> bool:
    """Every chunk up to the end has the checksum that it states."""
    view = memoryview(content)
    for kind, begin, end in _png_chunks(content):
        if zlib.crc32(view[begin - 4 : end]) != struct.unpack_from(">I", content, end)[0]:
            return False
        if kind == b"IEND":
            return True
    return False


def _png_chunks(content: Content) -> Iterator[tuple[bytes, int, int]]:
    """Kind of each whole chunk, where its data begin and where they end."""
    at = 8
    while at + 12 <= len(content):
        end = at + 8 + unpacked(">I", content, at)[0]
        if end + 4 > len(content):
            return
        yield content[at + 4 : at + 8], at + 8, end
        at = end + 4


def _png(content: Content) -> ImageHeader | None:
    width, height, depth, color = unpacked(">IIBB", content, 16)
    channels, has_alpha = 1 if color in _PNG_GREY else 3, color in _PNG_ALPHA
    for kind, _, _ in _png_chunks(content):
        has_alpha |= kind == b"tRNS"
        if kind == b"IDAT":
            break
    samples = 4 if has_alpha and channels == 3 else _PNG_SAMPLES.get(color, 4)
    return ImageHeader.of(width, height, channels, samples, max(1, depth // 8), has_alpha=has_alpha)


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
            depth, height, width, components = unpacked(">BHHB", content, at + 4)
            grey = components == 1
            return ImageHeader.of(width, height, 1 if grey else 3, 1 if grey else 4, 1 if depth == 8 else 2)
        else:
            at += 2 + unpacked(">H", content, at + 2)[0]
    return None


def _bmp(content: Content) -> ImageHeader | None:
    (header,) = unpacked("<I", content, 14)
    width, height = unpacked("<HH" if header == 12 else "<ii", content, 18)
    return ImageHeader.of(abs(width), abs(height), 3, 4)


def _webp(content: Content) -> ImageHeader | None:
    kind, at, has_alpha = content[12:16], 20, False
    if content[8:12] != b"WEBP":
        return None
    if kind == b"VP8X":
        width, height = (int.from_bytes(content[at + k : at + k + 3], "little") + 1 for k in (4, 7))
        has_alpha = bool(content[at] & 0x10)
    elif kind == b"VP8L":
        (packed,) = unpacked("<I", content, at + 1)
        width, height, has_alpha = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1, bool(packed >> 28 & 1)
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in unpacked("<HH", content, at + 6))
    else:
        return None
    return ImageHeader.of(width, height, 3, 4, has_alpha=has_alpha)


def _tiff(content: Content) -> ImageHeader | None:
    """By the tags of the first image; a tile, which is decoded whole, counts where it is larger."""
    tags = read_tiff_tags(content)
    if tags is None:
        return None
    samples, value_bytes = 1 if tags.samples == 1 else max(tags.samples, 4), max(1, (tags.bits + 7) // 8)
    padded = max(tags.width, tags.tile_width) * max(tags.height, tags.tile_height)
    has_alpha = tags.alpha is not None or tags.nodata is not None
    decoded_bytes = padded * samples * value_bytes
    return ImageHeader(tags.width, tags.height, tags.channels, value_bytes, decoded_bytes, has_alpha)


_READERS: dict[bytes, Callable[[Content], ImageHeader | None]] = {
    b"\xff\xd8": _jpeg,
    b"\x89PNG\r\n\x1a\n": _png,
    **dict.fromkeys(TIFF_MARKS, _tiff),
    b"BM": _bmp,
    b"RIFF": _webp,
}


def _status(path: Path, file: BinaryIO) -> os.stat_result:
    """Of an open file that may be read whole."""
    status = os.fstat(file.fileno())
    if status.st_size > LARGEST:
        raise UserError(f"{path} has {status.st_size:,} bytes; images have {LARGEST:,} at most.", _RESTORE)
    return status


def _unreadable(path: Path, error: OSError) -> UserError:
    name = str(path) if len(str(path)) <= 300 else f"{str(path)[:300]}..."
    return UserError(f"Cannot read {name}: {error.strerror or error}.", _RESTORE)
