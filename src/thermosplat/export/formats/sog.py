"""Gaussians as SOG, PlayCanvas's "spatially ordered Gaussians", version 2: lossless WebP images in a ZIP file.

A pixel of each image is a Gaussian, in the order of a Morton curve. Positions are 16-bit between bounds, after a
logarithm that keeps the sign; log-scales and colours are indices into codebooks of 256 numbers; quaternions have three
bytes and the index of the largest component; harmonics are an index into a palette of vectors, whose coefficients are
again indices into 256 numbers. Source: PlayCanvas's user manual, "The SOG format".
"""

import io
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.export.formats.codebooks import value_codebook, vector_codebook
from thermosplat.export.formats.packed_quaternions import smallest_three
from thermosplat.export.splats import SplatArrays, Splats, WrittenSplats, drawable, morton_order
from thermosplat.runs.atomic_writes import write_bytes

CODEBOOK = 256
"""Entries of a codebook: an index is a byte."""
_PALETTE_BLOCK, _MOST_BLOCKS = 1024, 64
_CENTROIDS_PER_ROW = 64
_QUATERNION_TAG = 252
"""Alpha of a quaternion whose largest component is w; 253 to 255: x, y, z."""


def write_sog(path: Path, splats: Splats) -> WrittenSplats:
    """Write Gaussians as SOG, in the frame of the capture's poses.

    Args:
        path: The file, ``*.sog``.

    Raises:
        UserError: No Gaussian is left to show: the format has no empty scene.
    """
    shown = drawable(splats)
    if len(shown) == 0:
        raise UserError(f"No Gaussian of {path.name} can be seen, and SOG holds no empty scene.", "Train for longer.")
    shown = shown[morton_order(shown.means)]
    meta = {"version": 2, "asset": {"generator": "thermosplat"}, "count": len(shown), "antialias": False}
    images: dict[str, NDArray[np.uint8]] = {}
    for part in (_positions, _scales, _quaternions, _colors, _harmonics):
        name, described, own = part(shown)
        if own:
            meta[name] = {**described, "files": list(own)}
            images |= own
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, data in (("meta.json", json.dumps(meta).encode()), *((n, _webp(i)) for n, i in images.items())):
            archive.writestr(zipfile.ZipInfo(name), data)  # without the time of day: the same scene, the same bytes
    write_bytes(path, content.getvalue())
    return WrittenSplats(path, len(shown), len(splats.means) - len(shown))


Part = tuple[str, dict[str, object], dict[str, NDArray[np.uint8]]]
"""Name of a property, what meta.json says about it, and its images by file name."""


def _positions(shown: SplatArrays) -> Part:
    squeezed = np.sign(shown.means) * np.log1p(np.abs(shown.means))
    low, high = squeezed.min(axis=0), squeezed.max(axis=0)
    shares = (squeezed - low) / np.maximum(high - low, 1e-12)
    steps = np.rint(shares * 65535.0).astype(np.uint16)
    images = {"means_l.webp": _image(steps & 255), "means_u.webp": _image(steps >> 8)}
    return "means", {"mins": low.tolist(), "maxs": high.tolist()}, images


def _scales(shown: SplatArrays) -> Part:
    book, labels = value_codebook(shown.log_scales, CODEBOOK)
    return "scales", {"codebook": book.tolist()}, {"scales.webp": _image(labels)}


def _quaternions(shown: SplatArrays) -> Part:
    largest, others = smallest_three(shown.quats)
    steps = np.rint((0.5 + others * np.sqrt(0.5)) * 255.0)
    return "quats", {}, {"quats.webp": _image(np.concatenate([steps, _QUATERNION_TAG + largest[:, None]], axis=1))}


def _colors(shown: SplatArrays) -> Part:
    book, labels = value_codebook(shown.sh0, CODEBOOK)
    opacities = np.rint(shown.opacities * 255.0)[:, None]
    return "sh0", {"codebook": book.tolist()}, {"sh0.webp": _image(np.concatenate([labels, opacities], axis=1))}


def _harmonics(shown: SplatArrays) -> Part:
    if shown.sh_degree == 0:
        return "shN", {}, {}
    bases = shown.shN.shape[1]
    blocks = min(_MOST_BLOCKS, 1 << max(0, int(np.log2(max(len(shown) / _PALETTE_BLOCK, 1.0)))))
    palette, labels = vector_codebook(shown.shN.reshape(len(shown), -1), blocks * _PALETTE_BLOCK)
    book, indices = value_codebook(palette, CODEBOOK)
    rows = -(-len(palette) // _CENTROIDS_PER_ROW)
    centroids = np.zeros((rows * _CENTROIDS_PER_ROW * bases, 3), np.uint8)
    centroids[: len(palette) * bases] = indices.reshape(-1, 3)  # a palette's entry is `bases` pixels in a row
    described = {"count": len(palette), "bands": shown.sh_degree, "codebook": book.tolist()}
    split = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    images = {"shN_centroids.webp": centroids.reshape(rows, -1, 3), "shN_labels.webp": _image(split)}
    return "shN", described, images


def _image(pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Pixels [M, channels] row by row in an image that is about square; what remains is 0."""
    width = 4 * -(-int(np.ceil(np.sqrt(len(pixels)))) // 4)
    height = 4 * -(-len(pixels) // (4 * width))
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, -1)


def _webp(image: NDArray[np.uint8]) -> bytes:
    """A lossless WebP file of an RGB or RGBA image."""
    order = [2, 1, 0, 3][: image.shape[2]]
    # beyond 100 OpenCV's quality means lossless
    return cv2.imencode(".webp", np.ascontiguousarray(image[..., order]), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
