"""Images and links that are there whole or not at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import write_atomically, write_bytes


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
    write_bytes(path, data.tobytes())


def link_whole(source: Path, path: Path) -> None:
    """Let a file be at another place, too: as a hard link, or as a copy where the file system has no links.

    Raises:
        UserError: It cannot be written.
    """
    link = path.with_name(f".{path.stem[:40]}.{secrets.token_hex(8)}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        os.link(source.resolve(), link)
        link.replace(path)  # does nothing if both are links of one file
    except OSError:

        def copy(temporary: Path) -> None:
            shutil.copyfile(source, temporary)

        write_atomically(path, copy)
    finally:
        with contextlib.suppress(OSError):  # the folder is none
            link.unlink()


def not_written(path: Path, error: OSError) -> UserError:
    """The error for a file that cannot be written."""
    return UserError(
        f"Cannot write {path}: {error.strerror or error}.",
        "Make room, or name a folder that can be written to with --out.",
    )
