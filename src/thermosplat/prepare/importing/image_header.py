"""Size and pixel type of an image file, from its header alone."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.regular_files import open_regular

_HEAD = 1 << 20
"""Bytes that are read first; the segments before a JPEG's size may hold radiometric data."""


@dataclass(frozen=True)
class ImageHeader:
    """What an image file holds.

    Args:
        width: [px] of the stored pixels.
        height: [px].
        channels: Of the stored pixels.
        bits: Of one value.
    """

    width: int
    height: int
    channels: int
    bits: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.width, self.height

    @property
    def is_radiometric(self) -> bool:
        """The file holds one value of more than 8 bits per pixel."""
        return self.channels == 1 and self.bits > 8


def read_header(path: Path) -> ImageHeader:
    """The header of an image file. Pixels are decoded for formats other than JPEG, so that a damaged file is found.

    Raises:
        UserError: The file cannot be read or is no image.
    """
    try:
        with open_regular(path) as file:
            head = file.read(_HEAD)
            found = jpeg_header(head)
            if found is None and head.startswith(b"\xff\xd8"):
                found = jpeg_header(head + file.read())
    except OSError as error:
        raise UserError(f"Cannot read {path}: {error.strerror or error}.") from error
    if found is not None:
        return found
    image = read_image(path)
    height, width = image.shape[:2]
    return ImageHeader(width, height, 1 if image.ndim == 2 else image.shape[2], 8 * np.dtype(image.dtype).itemsize)


def is_whole_jpeg(content: bytes) -> bool:
    """Whether a JPEG's image has an end; decoders show one that was cut off as half grey, without an error."""
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
        at += 1 if content[at + 1] == 0xFF else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return content.find(b"\xff\xd9", at) >= 0


def jpeg_header(content: bytes) -> ImageHeader | None:
    """The header of a JPEG's picture; None where there is none, or in another file."""
    at = 2 if content.startswith(b"\xff\xd8") else len(content)
    while at + 10 <= len(content) and content[at] == 0xFF:
        kind = content[at + 1]
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a frame header (ITU T.81, table B.1)
            bits, height, width, channels = struct.unpack_from(">BHHB", content, at + 4)
            return ImageHeader(width, height, channels, bits)
        if kind == 0xDA:
            return None
        at += 1 if kind == 0xFF else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return None
