"""The pixels of TIFFs as they are stored: by OpenCV where it reads that kind rightly, else by tifffile.

OpenCV 5.0 turns images by their orientation, scrambles planes of more than 8 bits, makes eight levels of 16-bit grey
with alpha, multiplies 8-bit colours by alpha, averages three samples that are not called colours, and stretches 10 to
14 bits. It has more compressions than tifffile, which needs imagecodecs for all of them.
"""

import importlib.util
import logging
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.tiff_tags import (
    BLACK_IS_ZERO,
    FLOATING,
    PALETTE,
    RGB,
    SIGNED,
    UNSIGNED,
    WHITE_IS_ZERO,
    YCBCR,
    TiffTags,
    upright,
)
from thermosplat.errors import UserError

_WHOLE = (1, 8, 16, 32, 64)
"""Bits of samples that tifffile unpacks by itself."""
_KINDS = {UNSIGNED: "u", SIGNED: "i", FLOATING: "f"}
_COMPRESSIONS = {
    **{2: "CCITT", 3: "CCITT", 4: "CCITT", 5: "LZW", 6: "JPEG", 7: "JPEG", 8: "Deflate", 32773: "PackBits"},
    **{32946: "Deflate", 34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 50000: "Zstandard", 50001: "WebP"},
}
CMYK = 5
_COLORS = {CMYK: "CMYK", 8: "CIE L*a*b*", 32803: "a colour filter array", 34892: "linear raw"}
_REMEDY = (
    "Save it anew as grey or RGB (magick IN.tif -colorspace sRGB OUT.png), or one band of it: "
    "gdal_translate -b 1 IN.tif OUT.tif"
)

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said here


def decode_tiff(path: Path, content: bytes, tags: TiffTags) -> NDArray[Any] | None:
    """The samples of a TIFF.

    Args:
        path: The file, for messages.
        content: What it holds.
        tags: What its tags say.

    Returns:
        [H, W] or [H, W, S] in the order of the file, of the type that it states; bits and palettes as 8 bits. None: it
        is damaged.

    Raises:
        UserError: Nothing here reads that kind rightly.
    """
    unread = _unread(tags)
    if unread is not None:
        raise UserError(f"{path} is a TIFF with {unread}, which is not read.", _REMEDY)
    if _opencv_is_right(tags) and tags.compression in _OF_OPENCV:
        return _by_opencv(content, tags)
    if tags.photometric not in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, None):
        raise UserError(f"{path} is a TIFF with colours that are stored in an unusual way.", _REMEDY)
    if importlib.util.find_spec("imagecodecs") is None and (tags.compression != 1 or tags.bits not in _WHOLE):
        compression = _COMPRESSIONS.get(tags.compression, f"of compression {tags.compression}")
        kind = f"{tags.bits} bits" if tags.compression == 1 else compression
        raise UserError(
            f"{path} is a TIFF of a kind ({kind}) that needs imagecodecs.",
            "Save it without compression, in 8, 16 or 32 bits. Or: pip install imagecodecs",
        )
    return _by_tifffile(content, tags)


def _unread(tags: TiffTags) -> str | None:
    """What no decoder here reads of such a file; None where there is nothing."""
    bits = tags.bits
    if tags.sample_format not in _KINDS or bits == 0:
        return "complex numbers" if tags.sample_format in (5, 6) else "samples of several or unknown types"
    kind = "floating-point numbers" if tags.sample_format == FLOATING else "numbers"
    if bits not in ((16, 32, 64) if tags.sample_format == FLOATING else (1, 2, 4, 8, 10, 12, 14, 16, 32, 64)):
        return f"{kind} of {bits} bits"
    if tags.photometric in _COLORS and not (tags.photometric == CMYK and bits == 8):
        return f"colours as {_COLORS[tags.photometric]} ({bits} bits)"
    if tags.channels == 1 and tags.samples > 1 and (tags.alpha is None or tags.samples > 2):
        return f"{tags.samples} bands of {bits} bits, of which nothing says what they are"
    if tags.samples > 1 and bits not in (8, 16, 32, 64):
        return f"{tags.samples} samples of {bits} bits in a pixel"
    return None


_OF_OPENCV = (1, 5, 6, 7, 8, 32773, 32946)
"""Compressions that the wheels of OpenCV have."""
_NUMBERS_OF_OPENCV = ((16, UNSIGNED), (16, SIGNED), (32, SIGNED), (32, FLOATING), (64, FLOATING))
"""Those of more than 8 bits, since OpenCV 4.10."""


def _opencv_is_right(tags: TiffTags) -> bool:
    """Whether OpenCV gives the samples as they are stored: measured on every combination of the tags (the tests)."""
    in_one_place = not tags.planar
    if (tags.bits, tags.sample_format) in _NUMBERS_OF_OPENCV:
        colored = tags.samples in (3, 4) and tags.photometric == RGB
        grey = tags.samples == 1 and tags.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO)
        return in_one_place and (colored or grey)
    if tags.bits == 8 and tags.sample_format == UNSIGNED:
        if tags.tile_width > 0 and tags.compression == 1 and tags.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB):
            return False  # OpenCV 5.0 reads no plain tiles
        if tags.samples == 1:
            return tags.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO, PALETTE)
        if tags.samples == 4:
            return in_one_place and tags.photometric == CMYK
        return in_one_place and tags.samples == 3 and tags.photometric in (RGB, YCBCR)
    return tags.bits == 1 and tags.samples == 1 and tags.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO)


def _by_opencv(content: bytes, tags: TiffTags) -> NDArray[Any] | None:
    try:
        image = cv2.imdecode(np.frombuffer(upright(content, tags), np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError):
        return None
    if image is None or image.shape[:2] != (tags.height, tags.width):
        return None
    if image.ndim == 2:
        return image if tags.channels == 1 and image.dtype == _stored_type(tags) else None
    if image.dtype != _stored_type(tags) or image.shape[2] not in (3, 4):
        return None
    order = [2, 1, 0, 3] if image.shape[2] == 4 and tags.photometric == RGB else [2, 1, 0]
    return np.ascontiguousarray(image[..., order])


def _stored_type(tags: TiffTags) -> np.dtype[Any]:
    return np.dtype(f"{_KINDS[tags.sample_format]}{max(8, tags.bits) // 8}")


def _by_tifffile(content: bytes, tags: TiffTags) -> NDArray[Any] | None:
    import tifffile

    try:
        with tifffile.TiffFile(BytesIO(content)) as file:
            page = file.pages.first
            whole = all(at + size <= len(content) for at, size in zip(page.dataoffsets, page.databytecounts))
            image = np.asarray(page.asarray(maxworkers=1)) if whole else np.empty(0)
    except Exception:  # tifffile raises many kinds for a damaged file
        return None
    if tags.planar and image.ndim == 3:
        image = np.moveaxis(image, 0, -1)
    if image.shape != (tags.height, tags.width, *((tags.samples,) if tags.samples > 1 else ())):
        return None
    if tags.bits < 8:
        most = 2**tags.bits - 1
        image = (image.astype(np.uint8) * np.uint8(255 // most)).astype(np.uint8)
    if tags.bits <= 8 and tags.photometric == WHITE_IS_ZERO:
        image = np.concatenate([np.invert(image[..., :1]), image[..., 1:]], -1) if image.ndim == 3 else np.invert(image)
    return np.ascontiguousarray(image.astype(np.float32) if image.dtype == np.float16 else image)
