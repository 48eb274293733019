"""Images as people look at them: 8-bit colours of photographs, measured values and errors.

Convention: all images are numpy [H, W, C]; 8-bit images are in RGB order (OpenCV's own writers want BGR).
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.regular_files import read_regular
from thermosplat.runs.atomic_writes import write_bytes
from thermosplat.thermal.radiometry import PixelScale

Image8 = NDArray[np.uint8]
_NO_SPAN = 1e-30
"""Stands for a largest error of 0, by which nothing can be divided."""


def rgb_bytes(image: NDArray[np.floating]) -> Image8:
    """Colours to 8 bits, clamped.

    Args:
        image: Colours, 0 to 1, shape [H, W, 3].
    """
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def spectrum_bytes(image: NDArray[np.floating], scale: PixelScale, shown: tuple[float, float] | None = None) -> Image8:
    """An image of any spectrum as 8-bit colours: as it is where it has colours, through the palette where it has one
    value.

    Args:
        image: Image, 0 to 1, shape [H, W, 3] or [H, W, 1] as the scale's kind says.
        shown: Values at the palette's ends, of an image of values; None: those that 0 and 1 stand for.
    """
    if scale.channels == 3:
        return rgb_bytes(image[..., :3])
    shares = np.clip(image[..., 0], 0.0, 1.0)
    if shown is not None and scale.range is not None and shown != scale.range:
        shares = (scale.value(shares) - shown[0]) / max(shown[1] - shown[0], _NO_SPAN)
    return rgb_bytes(scale.palette.to_color(np.clip(shares, 0.0, 1.0)))


def error_bytes(error: NDArray[np.floating], largest: float) -> Image8:
    """An error map in the Inferno palette: black is none, pale yellow is ``largest`` or more.

    Args:
        error: Absolute errors, shape [H, W].
        largest: Error at the palette's bright end, in the unit of ``error``; 0 where a capture has one value only.
    """
    levels = np.rint(np.clip(error / max(largest, _NO_SPAN), 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])


def depth_bytes(depth: NDArray[np.floating], nearest: float, farthest: float) -> Image8:
    """A depth map in the Turbo palette, logarithmic: red is near, blue is far, black is nothing.

    Args:
        depth: Depths, 0 where nothing is, shape [H, W].
        nearest: Depth at the palette's red end, > 0.
        farthest: Depth at its blue end, > ``nearest``.
    """
    there = depth > 0
    shares = np.log(farthest / np.where(there, depth, farthest)) / np.log(farthest / nearest)
    levels = np.rint(np.clip(shares, 0.0, 1.0) * 255.0).astype(np.uint8)
    colors = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(there[..., None], colors, 0).astype(np.uint8)


def write_png(path: Path, image: Image8) -> None:
    """Write an 8-bit RGB image as PNG; the file appears at once and whole.

    Args:
        path: The file; its folder is made where there is none.
        image: Shape [H, W, 3].
    """
    write_bytes(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def write_values(path: Path, values: NDArray[np.float32]) -> None:
    """Write measured values [H, W] as a TIFF of 32-bit floats; the file appears at once and whole."""
    write_bytes(path, cv2.imencode(".tiff", values)[1].tobytes())


def side_by_side(images: Sequence[Image8]) -> Image8:
    """Images beside each other; they are scaled to the height of the first where theirs differ.

    Args:
        images: At least one, each of shape [H', W', 3].

    Returns:
        Shape [H, sum of the widths, 3].
    """
    height = images[0].shape[0]
    scaled = [
        image
        if image.shape[0] == height
        else resized(image, max(1, round(image.shape[1] * height / image.shape[0])), height)
        for image in images
    ]
    return np.concatenate(scaled, axis=1)


def resized(image: Image8, width: int, height: int) -> Image8:
    """An 8-bit image at another size [px]; enlarged without smoothing, so that its pixels stay visible."""
    enlarged = width >= image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST if enlarged else cv2.INTER_AREA)


def fitted(image: Image8, width: int, height: int) -> Image8:
    """An 8-bit image in the middle of another size [px], as large as it fits with its own proportions; black around."""
    scale = min(width / image.shape[1], height / image.shape[0])
    inside = resized(image, max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
    top, left = (height - inside.shape[0]) // 2, (width - inside.shape[1]) // 2
    framed = np.zeros((height, width, 3), np.uint8)
    framed[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return framed


def read_png(path: Path) -> Image8 | None:
    """An 8-bit RGB image [H, W, 3] from a file that `write_png` wrote; None where there is none that can be read."""
    try:
        content = np.frombuffer(read_regular(path), np.uint8)  # by name OpenCV crashes where that is no UTF-8
        image = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    except (OSError, cv2.error):
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
