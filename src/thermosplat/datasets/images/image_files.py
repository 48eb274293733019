"""Image files into arrays: 8-bit colour, 8-bit grey, 16-bit and floating-point, each as it is stored."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_bytes import (
    LARGEST,
    TIFF_MARKS,
    ImageHeader,
    image_header,
    is_cut_or_changed,
    is_grey16_with_alpha,
    read_regular_file,
    transparent_level,
)
from thermosplat.datasets.images.tiff_pixels import decode_tiff
from thermosplat.datasets.images.tiff_tags import UNASSOCIATED, TiffTags, read_tiff_tags
from thermosplat.datasets.images.unread_formats import unread_content
from thermosplat.errors import UserError
from thermosplat.regular_files import files_below, files_in

JPEG_SUFFIXES = frozenset({".jpg", ".jpeg", ".jfif", ".jpe"})
IMAGE_SUFFIXES = frozenset({*JPEG_SUFFIXES, ".png", ".tif", ".tiff", ".bmp", ".webp"})
_RESTORE = "Restore it, or remove it from the folder."

# `read_pixels` reports unreadable files, not OpenCV on the side. (OpenCV 4 and 5 name the function differently.)
_set_log_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
_set_log_level(1)  # fatal errors only


def list_images(folder: Path, *, recursive: bool = False) -> list[Path]:
    """Image files in a folder, sorted by name; empty where there is no such folder."""
    files = files_below(folder) if recursive else files_in(folder)
    return [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]


@dataclass(frozen=True, eq=False)
class ImagePixels:
    """What an image file holds.

    Args:
        image: [H, W] for one channel, [H, W, 3] RGB for colour, as the file stores it.
        mask: bool [H, W], False where the file says that there is nothing (alpha); None: it is so nowhere.
        void: bool [H, W], True where the file says that a value is none (NoData); None: nowhere.
    """

    image: NDArray[Any]
    mask: NDArray[np.bool_] | None = None
    void: NDArray[np.bool_] | None = None


def read_image(path: Path) -> NDArray[Any]:
    """Pixels as the file stores them; orientation is ignored, as COLMAP ignores it.

    Returns:
        [H, W] for one channel, [H, W, 3] RGB for colour (alpha is dropped); uint8, uint16, float32 or another type of
        numbers that TIFFs have. Values that the file calls none are NaN.

    Raises:
        UserError: As ``read_pixels``.
    """
    pixels = read_pixels(path)
    return pixels.image if pixels.void is None else np.where(pixels.void, np.float32(np.nan), pixels.image)


def read_pixels(path: Path) -> ImagePixels:
    """An image, and which of its pixels hold something.

    Raises:
        UserError: The file is missing, damaged, no image, larger than ``LARGEST``, or of a kind that is not read. JPEG
            files whose decoder fills gaps pass; ``check_jpegs`` finds them.
    """
    content = read_regular_file(path)
    header = image_header(content)
    if header is not None and header.decoded_bytes > LARGEST:
        raise UserError(
            f"{path} would take {header.decoded_bytes:,} bytes of memory; images take {LARGEST:,} at most.",
            "Is it an image of the capture? Shrink it, or remove it from the folder.",
        )
    pixels = None if header is None or is_cut_or_changed(content) else _decode(path, content, header)
    if pixels is None or pixels.image.size == 0:
        raise unread_content(path, content) or UserError(
            f"{path} is damaged or not an image ({len(content):,} bytes).", _RESTORE
        )
    return pixels


def _decode(path: Path, content: bytes, header: ImageHeader) -> ImagePixels | None:
    tags = read_tiff_tags(content) if content.startswith(TIFF_MARKS) else None
    if tags is not None:
        samples = decode_tiff(path, content, tags)
        return None if samples is None else _of_tiff(samples, tags)
    if is_grey16_with_alpha(content):
        raise UserError(
            f"{path} is a PNG of 16-bit grey with an alpha channel, which OpenCV reads wrongly.",
            "Save it without alpha: magick IN.png -alpha off OUT.png",
        )
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError):
        return None
    if image is None:
        return None
    if image.ndim == 2:
        level = transparent_level(content)
        return ImagePixels(image, None if level is None else _unless_all(image != level))
    mask = _unless_all(image[..., 3] > 0) if image.shape[2] == 4 else None
    return ImagePixels(_rgb_of(image) if header.channels == 3 else np.ascontiguousarray(image[..., 0]), mask)


def _of_tiff(samples: NDArray[Any], tags: TiffTags) -> ImagePixels:
    """Image, alpha and NoData of what was decoded."""
    image, mask = samples, None
    if samples.ndim == 3:
        image = np.ascontiguousarray(samples[..., 0] if tags.channels == 1 else samples[..., :3])
        if tags.alpha is not None and tags.alpha[0] < samples.shape[2]:
            sample, kind = tags.alpha
            alpha = samples[..., sample]
            # colours that were multiplied by their alpha are right where it is full
            full = np.iinfo(alpha.dtype).max if alpha.dtype.kind in "iu" else 1.0
            mask = _unless_all(alpha > 0 if kind == UNASSOCIATED else alpha >= full)
    void = void_pixels(image, tags.nodata)
    if void is not None and (image.ndim == 3 or image.dtype == np.uint8):  # a picture has no values that could lack
        mask, void = ~void if mask is None else mask & ~void, None
    return ImagePixels(image, mask, void)


def _unless_all(mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return None if mask.all() else mask


def _rgb_of(image: NDArray[Any]) -> NDArray[Any]:
    """Colours of OpenCV's decoder [H, W, 3 or 4] in the other order, without alpha."""
    if image.dtype in (np.uint8, np.uint16, np.float32):  # what cvtColor takes; it is many times faster
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
    return np.ascontiguousarray(image[..., 2::-1])


def resize(image: NDArray[Any], width: int, height: int, *, exact: bool = False) -> NDArray[Any]:
    """The image resampled to another size: by area averages where it shrinks, bilinear where it grows.

    Args:
        image: [H, W] or [H, W, C].
        width: The new width [px].
        height: The new height [px].
        exact: Take the nearest pixel: there is no mean between two.
    """
    if image.shape[1::-1] == (width, height):
        return image
    if exact:
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


_CLOSE = 1e-6
"""Relative difference from NoData that counts as none: the tag is a text, and rounded."""
_NOT_MEASURED = 1e20
"""Size from which on a floating-point number is a fill value: ±3.4e38 (GIS), 9.97e36 (netCDF), 1e20 (CF)."""
_FILL_VALUES = (-9999.0, -32768.0, -32767.0)
"""Fill values that programs write without saying so, where all other values lie far above."""


def void_pixels(image: NDArray[Any], nodata: float | None) -> NDArray[np.bool_] | None:
    """Where an image has no value, bool [H, W]; None: it has one everywhere.

    Args:
        image: [H, W], or [H, W, 3], where all three have to be NoData.
        nodata: The value that the file calls NoData; None: it says nothing.
    """
    void: NDArray[np.bool_] = np.zeros(image.shape, np.bool_)
    if nodata is not None:
        void |= np.isnan(image) if np.isnan(nodata) else np.isclose(image, nodata, _CLOSE, 0.0)
    if image.ndim == 2 and image.dtype.kind == "f":
        void |= np.abs(image) >= _NOT_MEASURED
    if image.ndim == 2 and image.dtype.kind in "if":
        for value in _FILL_VALUES:
            filled = image == value
            if filled.any() and (image[~(filled | void)] > value / 2).all():
                void |= filled
    pixels = np.all(void.reshape(*image.shape[:2], -1), axis=-1)
    return pixels if pixels.any() else None
