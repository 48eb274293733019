"""Images as people look at them: 8-bit colours of RGB, thermal and error images.

Convention: all images are numpy [H, W, C]; 8-bit images are in RGB order (OpenCV's own writers want BGR).
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.checkpoint import write_atomically
from thermosplat.radiometry import ThermalScale

Image8 = NDArray[np.uint8]
_NO_SPAN = 1e-30
"""Stands for a largest error of 0, by which nothing can be divided."""


def rgb_bytes(image: NDArray[np.floating]) -> Image8:
    """Colours to 8 bits, clamped.

    Args:
        image: Colours, 0 to 1, shape [H, W, 3].
    """
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def thermal_bytes(image: NDArray[np.floating], scale: ThermalScale) -> Image8:
    """A thermal image as 8-bit colours: as it is where it is pseudo-coloured, through the palette where it is a scalar.

    Args:
        image: Thermal image, 0 to 1, shape [H, W, 3] or [H, W, 1] as the scale's kind says.
        scale: What the capture's thermal values mean.
    """
    if scale.kind == "color":
        return rgb_bytes(image)
    return rgb_bytes(scale.palette.to_color(np.clip(image[..., 0], 0.0, 1.0)))


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
    content = cv2.imencode(".png", image[..., ::-1])[1].tobytes()

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)

    write_atomically(path, write)


def side_by_side(left: Image8, right: Image8) -> Image8:
    """Two images beside each other; the right one is scaled to the left one's height if it differs.

    Args:
        left: Shape [H, W, 3].
        right: Shape [H', W', 3].

    Returns:
        Shape [H, W + W'·H/H', 3].
    """
    if right.shape[0] != left.shape[0]:
        width = max(1, round(right.shape[1] * left.shape[0] / right.shape[0]))
        right = resized(right, width, left.shape[0])
    return np.concatenate([left, right], axis=1)


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
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if image is None else np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
