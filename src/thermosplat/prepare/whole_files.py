"""Files that are there whole or not at all."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it; folders above it are made.

    Raises:
        UserError: It cannot be written.
    """
    temporary = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        raise not_written(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image [H, W] or [H, W, 3] RGB as a PNG, whole.

    Raises:
        UserError: It cannot be written.
    """
    _write_image(path, ".png", image)


def write_jpeg(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image [H, W, 3] RGB as a JPEG of quality 95, whole.

    Raises:
        UserError: It cannot be written.
    """
    _write_image(path, ".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])


def _write_image(path: Path, ending: str, image: NDArray[Any], settings: Sequence[int] = ()) -> None:
    stored = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    done, data = cv2.imencode(ending, stored, list(settings))
    if not done:
        raise UserError(f"OpenCV cannot write {path} ({image.shape}, {image.dtype}).")
    write_whole(path, data.tobytes())


def link_whole(source: Path, path: Path) -> None:
    """Let a file be at another place, too: as a hard link, or as a copy where the file system has no links.

    Raises:
        UserError: It cannot be written.
    """
    temporary = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        try:
            os.link(source.resolve(), temporary)
        except OSError:
            shutil.copyfile(source, temporary)
        temporary.replace(path)  # does nothing if both are links of one file
    except OSError as error:
        raise not_written(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def not_written(path: Path, error: OSError) -> UserError:
    """The error for a file that cannot be written."""
    return UserError(
        f"Cannot write {path}: {error.strerror or error}.",
        "Make room, or name a folder that can be written to with --out.",
    )


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")
