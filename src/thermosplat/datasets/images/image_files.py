"""Image files into arrays: 8-bit colour, 8-bit grey, 16-bit and floating-point, each as it is stored."""

import os
import warnings
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_bytes import (
    LARGEST,
    decoded_bytes,
    is_cut_or_changed,
    lacks_photometric_tag,
    read_regular_file,
)
from thermosplat.errors import UserError

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})

# `read_image` reports unreadable files, not OpenCV on the side. (OpenCV 4 and 5 name the function differently.)
_set_log_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
_set_log_level(1)  # fatal errors only


def list_images(folder: Path, *, recursive: bool = False) -> list[Path]:
    """Image files in a folder, sorted by name; empty where there is no such folder."""
    if not os.path.isdir(folder):  # also for a name that is too long
        return []
    entries = _files_below(folder) if recursive else folder.iterdir()
    return sorted(path for path in entries if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith("."))


def _files_below(folder: Path) -> Iterator[Path]:
    """Files at any depth, also in folders that are links; each folder once, as links may go in a circle."""
    seen = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        yield from (Path(place, name) for name in files)


def read_image(path: Path) -> NDArray[Any]:
    """Pixels as the file stores them; EXIF orientation is ignored, as COLMAP ignores it.

    Returns:
        [H, W] for one channel, [H, W, 3] RGB for colour (alpha is dropped); uint8, uint16, float32 or float64.

    Raises:
        UserError: The file is missing, damaged, no image, or larger than ``LARGEST``. JPEG files whose decoder fills
            gaps pass; ``check_jpegs`` finds them.
    """
    content = read_regular_file(path)
    memory = decoded_bytes(content)
    if memory is not None and memory > LARGEST:
        raise UserError(
            f"{path} would take {memory:,} bytes of memory; images take {LARGEST:,} at most.",
            "Is it an image of the capture? Shrink it, or remove it from the folder.",
        )
    image = None if memory is None or is_cut_or_changed(content) else _decode(path, content)
    if image is None or image.size == 0:
        size = f"{len(content):,} bytes"
        raise UserError(f"{path} is damaged or not an image ({size}).", "Restore it, or remove it from the folder.")
    if image.ndim == 3:
        if image.shape[2] not in (3, 4):
            raise UserError(f"{path} has {image.shape[2]} channels; 1 (values) or 3 (colour) are expected.")
        image = _in_rgb_order(image)
    return image


def _in_rgb_order(image: NDArray[Any]) -> NDArray[Any]:
    """Colours of OpenCV's decoder [H, W, 3 or 4] in the other order, without alpha."""
    if image.dtype in (np.uint8, np.uint16, np.float32):  # what cvtColor takes; it is many times faster
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
    return np.ascontiguousarray(image[..., 2::-1])


def resize(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """The image resampled to another size: by area averages where it shrinks, bilinear where it grows."""
    if image.shape[1::-1] == (width, height):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _decode(path: Path, content: bytes) -> NDArray[Any] | None:
    """The decoded image as OpenCV gives it (BGR), or None."""
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError):
        return None
    return _decode_with_pillow(path, content) if image is None and lacks_photometric_tag(content) else image


def _decode_with_pillow(path: Path, content: bytes) -> NDArray[Any] | None:
    """TIFFs without a photometric tag, which OpenCV 5 refuses; None if Pillow cannot read it either."""
    try:
        from PIL import Image
    except ImportError as error:
        raise UserError(f"OpenCV cannot read {path}.", "Pillow may: pip install pillow.") from error
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(BytesIO(content), formats=["TIFF"]) as image:
            pixels = np.asarray(image)
    except Exception:  # Pillow raises many kinds for a damaged file
        return None
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype.kind in "iu" and pixels.dtype.itemsize == 4:
        pixels = pixels.astype(np.float32)
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
