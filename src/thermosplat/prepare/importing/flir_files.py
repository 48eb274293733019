"""FLIR's radiometric JPEGs: counts, calibration, what the camera can measure, and the embedded photograph.

The layout of the records is documented by ExifTool (lib/Image/ExifTool/FLIR.pm). Each begins with a number below 256
that tells its byte order.
"""

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.flir_metadata import fff_file, fff_record
from thermosplat.datasets.images.image_bytes import LARGEST, read_regular_file
from thermosplat.errors import UserError
from thermosplat.thermal.planck_counts import ZERO_CELSIUS, RadiometricCamera

_RAW, _PHOTOGRAPH, _CAMERA = 0x01, 0x0E, 0x20
_JPEG_LS = b"\xff\xd8\xff\xf7"
"""How a JPEG-LS image begins."""
_PIXELS_AT = 0x20
"""Where pixels begin in the records of images."""
_FLOATS = {
    "emissivity": 0x20,
    "distance": 0x24,
    "reflected": 0x28,
    "air": 0x2C,
    "window": 0x30,
    "window_transmission": 0x34,
    "humidity": 0x3C,
    "r1": 0x58,
    "b": 0x5C,
    "f": 0x60,
    "alpha1": 0x70,
    "alpha2": 0x74,
    "beta1": 0x78,
    "beta2": 0x7C,
    "x": 0x80,
    "r2": 0x30C,
}
"""Where a camera's record has its numbers (float32)."""
_OFFSET_AT = 0x308
"""Where it has Planck's O (int32)."""
_HIGHEST_AT, _LOWEST_AT = 0x98, 0x9C
"""Where it has the temperatures between which the camera shows a number at all (float32 [K])."""
_ROUGHER = 4
"""How many times more counts must differ from their neighbours in one byte order for the other to be the right one; a
wrong order gives 100 to 700 times as much (eight cameras)."""


@dataclass(frozen=True, eq=False)
class FlirImage:
    """What a radiometric JPEG of FLIR's holds beside the picture that is seen.

    Args:
        counts: [H, W] uint16.
        span: Lowest and highest temperature that the camera can measure [°C], as the file states them.
        photograph: The bytes of the photograph of the same moment (JPEG or PNG), if there is one.
    """

    counts: NDArray[np.uint16]
    camera: RadiometricCamera
    span: tuple[float, float]
    photograph: bytes | None

    @property
    def celsius(self) -> NDArray[np.float64]:
        """[H, W] temperatures [°C]."""
        return self.camera.celsius(self.counts)


def is_flir(content: bytes) -> bool:
    """Whether a JPEG holds radiometric data of FLIR's."""
    try:
        return len(fff_record(fff_file(content), _RAW)) > _PIXELS_AT
    except (struct.error, LookupError):
        return False


def read_flir(path: Path) -> FlirImage:
    """Read a radiometric JPEG.

    Raises:
        UserError: The file cannot be read, or its radiometric data is missing or damaged.
    """
    with _named(path):
        fff = fff_file(read_regular_file(path))
        record = fff_record(fff, _CAMERA)
        return FlirImage(_counts(fff_record(fff, _RAW)), _camera(record), _span(record), _photograph(fff))


def read_flir_camera(path: Path) -> RadiometricCamera:
    """The calibration alone, without decoding the counts.

    Raises:
        UserError: As for ``read_flir``.
    """
    with _named(path):
        return _camera(fff_record(fff_file(read_regular_file(path)), _CAMERA))


def has_photograph(path: Path) -> bool:
    """Whether a radiometric JPEG holds a photograph of the same moment."""
    return _photograph(fff_file(read_regular_file(path))) is not None


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors inside become a sentence with the file's name."""
    try:
        yield
    except UserError as error:
        named = error.message if str(path) in error.message else f"{path}: {error.message}"
        raise UserError(named, error.hint) from error
    except (struct.error, LookupError, ValueError) as error:
        raise UserError(
            f"The radiometric data in {path} is damaged: {error}",
            "Copy the file from the camera again; programs that edit pictures drop what they do not know.",
        ) from error


def _order(record: bytes) -> str:
    return "<" if struct.unpack_from("<H", record)[0] < 0x100 else ">"


def _counts(record: bytes) -> NDArray[np.uint16]:
    order = _order(record)
    width, height = struct.unpack_from(order + "HH", record, 2)
    pixels = record[_PIXELS_AT:]
    if 2 * width * height > LARGEST or _claimed_size(pixels) not in (None, (width, height)):
        raise ValueError(f"its image is not one of {width}x{height} px with 16 bits.")  # before memory is taken
    if pixels.startswith(b"\x89PNG"):
        image: Any = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_UNCHANGED)
        # most cameras write the record's order, which is not PNG's own: the ThermaCAM EX320 is big-endian throughout
        counts = None if image is None else image.byteswap() if order == "<" else image
    elif pixels.startswith(_JPEG_LS):
        counts = _decode_jpeg_ls(pixels)
    else:
        if len(pixels) < 2 * width * height:
            raise ValueError(f"{width}x{height} px need {2 * width * height:,} bytes, there are {len(pixels):,}.")
        counts = np.frombuffer(pixels, order + "u2", width * height).reshape(height, width).astype(np.uint16)
    if counts is None or counts.dtype != np.uint16 or counts.shape != (height, width) or counts.size == 0:
        raise ValueError(f"its image is not one of {width}x{height} px with 16 bits.")
    other = counts.byteswap()
    return other if _ROUGHER * _roughness(other) < _roughness(counts) else counts


def _roughness(counts: NDArray[np.uint16]) -> float:
    """How much neighbouring counts differ: next to nothing in a picture whose bytes are in the right order."""
    return float(np.abs(np.diff(counts.ravel().astype(np.int32))).sum())


def _claimed_size(pixels: bytes) -> tuple[int, int] | None:
    """Width and height that a compressed image's header states; None for plain pixels."""
    if pixels.startswith(b"\x89PNG"):
        return struct.unpack_from(">II", pixels, 16)
    if pixels.startswith(_JPEG_LS):
        height, width = struct.unpack_from(">HH", pixels, 7)
        return width, height
    return None


def _decode_jpeg_ls(pixels: bytes) -> NDArray[np.uint16]:
    """What cameras since about 2020 write (E6xt of RGBT-Scenes)."""
    try:
        import jpeg_ls
    except ImportError as error:
        raise UserError(
            "This camera compresses its counts with JPEG-LS, which needs the package pyjpegls.",
            "pip install pyjpegls",
        ) from error
    try:
        return jpeg_ls.decode(np.frombuffer(pixels, np.uint8))
    except (RuntimeError, OSError) as error:
        raise ValueError(f"its JPEG-LS image cannot be decoded ({error}).") from error


def _camera(record: bytes) -> RadiometricCamera:
    order = _order(record)
    numbers = {name: struct.unpack_from(order + "f", record, at)[0] for name, at in _FLOATS.items()}
    if numbers["humidity"] > 2:  # some cameras store percent (ExifTool)
        numbers["humidity"] /= 100
    return RadiometricCamera(**numbers, o=struct.unpack_from(order + "i", record, _OFFSET_AT)[0])


def _span(record: bytes) -> tuple[float, float]:
    """Lowest and highest temperature that the camera can measure [°C]; without end where the file does not say."""
    order = _order(record)
    lowest, highest = (struct.unpack_from(order + "f", record, at)[0] for at in (_LOWEST_AT, _HIGHEST_AT))
    if not (0 <= lowest < highest and math.isfinite(highest)):
        return -math.inf, math.inf
    return lowest - ZERO_CELSIUS, highest - ZERO_CELSIUS


def _photograph(fff: bytes) -> bytes | None:
    try:
        content = fff_record(fff, _PHOTOGRAPH)[_PIXELS_AT:]
    except (struct.error, LookupError):
        return None
    return content if content.startswith((b"\xff\xd8", b"\x89PNG")) else None
