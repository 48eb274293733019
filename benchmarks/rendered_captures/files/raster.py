"""Image files of a capture."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray


def write_jpeg(path: Path, image: NDArray[np.uint8], quality: int, exif: bytes = b"") -> None:
    """Write an image [H, W, 3] of red, green and blue.

    Args:
        path: Of the file; its folder is made.
        image: What to write.
        quality: Of OpenCV, 0 to 100.
        exif: A segment of metadata, from ``Exif`` on.
    """
    done, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    data = encoded.tobytes()
    if exif:
        data = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def write_counts(path: Path, counts: NDArray[np.uint16]) -> None:
    """Write 16-bit values as TIFF."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, counts, compression="zlib", predictor=True)


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write a grey image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
