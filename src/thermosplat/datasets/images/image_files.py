"""Image files into arrays: 8-bit colour, 8-bit grey, 16-bit and floating-point, each as it is stored."""

import os
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})

# `read_image` reports unreadable files, not OpenCV on the side. (OpenCV 4 and 5 name the function differently.)
_set_log_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
_set_log_level(1)  # fatal errors only


def list_images(folder: Path, *, recursive: bool = False) -> list[Path]:
    """Image files in a folder, sorted by name; empty where there is no such folder."""
    if not folder.is_dir():
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
        UserError: The file is missing, damaged or no image.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise UserError(f"Cannot read {path}: {error.strerror or error}.") from error
    image = _decode(path, data)
    if image is None:
        size = f"{len(data):,} bytes"
        raise UserError(f"{path} is damaged or not an image ({size}).", "Restore it, or remove it from the folder.")
    if image.ndim == 3:
        if image.shape[2] not in (3, 4):
            raise UserError(f"{path} has {image.shape[2]} channels; 1 (values) or 3 (colour) are expected.")
        image = np.ascontiguousarray(image[..., 2::-1])
    return image


def read_images(paths: Iterable[Path]) -> list[NDArray[Any]]:
    """`read_image` of many files, several at a time."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(read_image, paths))


def resize(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """The image resampled to another size: by area averages where it shrinks, bilinear where it grows."""
    if image.shape[1::-1] == (width, height):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _decode(path: Path, data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """The decoded image as OpenCV gives it (BGR), or None.

    Some versions of OpenCV decode a JPEG or PNG that was cut off to a half-grey picture without an error, so its end
    mark is looked for first.
    """
    content = data.tobytes()
    if content.startswith(b"\xff\xd8") and b"\xff\xd9" not in content:
        return None
    if content.startswith(b"\x89PNG") and b"IEND" not in content:
        return None
    if len(data) == 0:
        return None
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None and content[:4] in (b"II*\0", b"MM\0*"):
        return _decode_with_pillow(path)
    return image


def _decode_with_pillow(path: Path) -> NDArray[Any] | None:
    """TIFFs without a photometric tag (Workswell cameras), which OpenCV 5 refuses; None without Pillow."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise UserError(f"OpenCV cannot read {path}.", "Pillow may: pip install pillow.") from error
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            pixels = np.asarray(image)
    except (OSError, UnidentifiedImageError, ValueError):
        return None
    if pixels.dtype.kind in "iu" and pixels.dtype.itemsize == 4:
        pixels = pixels.astype(np.float32)
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
