"""Gaussians as PlayCanvas's compressed PLY: 16 bytes per Gaussian, and 1 byte per coefficient above degree 0.

Chunks of 256 Gaussians state the lowest and highest position, log-scale and colour; a Gaussian states where it lies
between them, in 11, 10 and 11 bits for x, y and z, and in 8 bits for each colour and the opacity. A quaternion is a
2-bit index of its largest component and 10 bits for each of the others. Source: PlayCanvas's user manual, "PLY", and
the elements that SuperSplat writes.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.export.formats.packed_quaternions import smallest_three
from thermosplat.export.formats.ply import comment_lines
from thermosplat.export.splats import SplatArrays, Splats, WrittenSplats, drawable, morton_order
from thermosplat.runs.atomic_writes import write_bytes
from thermosplat.scene.gaussians import SH_C0

CHUNK = 256
"""Gaussians that share bounds."""
LARGEST_LOG_SCALE = 20.0
"""Log-scales are clamped to this magnitude, as SuperSplat does."""
SH_STEPS = 32.0
"""Steps of a coefficient's byte for each unit: 256 steps from -4 to 4."""
_BOUNDS = [f"{end}_{name}" for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
           for end in ("min", "max") for name in names]  # fmt: skip
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_compressed_ply(path: Path, splats: Splats, comments: Iterable[str] = ()) -> WrittenSplats:
    """Write Gaussians as compressed PLY, in the frame of the capture's poses.

    Args:
        path: The file, by convention ``*.compressed.ply``.
    """
    shown = drawable(splats)
    shown = shown[morton_order(shown.means)]
    bounds, packed = _packed(shown)
    header = ["ply", "format binary_little_endian 1.0", *comment_lines(comments)]
    header += [f"element chunk {len(bounds)}", *(f"property float {name}" for name in _BOUNDS)]
    header += [f"element vertex {len(packed)}", *(f"property uint {name}" for name in _PACKED)]
    content = bounds.astype("<f4").tobytes() + packed.astype("<u4").tobytes()
    if shown.sh_degree > 0:
        coefficients = shown.shN.transpose(0, 2, 1).reshape(len(shown), -1)  # channel by channel, as f_rest
        header += [f"element sh {len(shown)}"]
        header += [f"property uchar f_rest_{i}" for i in range(coefficients.shape[1])]
        content += np.clip(np.floor((coefficients + 4.0) * SH_STEPS), 0, 255).astype(np.uint8).tobytes()
    write_bytes(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii", errors="replace") + content)
    return WrittenSplats(path, len(shown), len(splats.means) - len(shown))


def _packed(shown: SplatArrays) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Bounds of each chunk [C, 18], and four words of each Gaussian [M, 4]."""
    scales = np.clip(shown.log_scales, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    starts = np.arange(0, len(shown), CHUNK)
    bounds, shares = [], []
    for values in (shown.means, scales, 0.5 + SH_C0 * shown.sh0):
        low, high = (reduce(values, starts, axis=0) if len(starts) else np.zeros((0, 3), np.float32)
                     for reduce in (np.minimum.reduceat, np.maximum.reduceat))  # fmt: skip
        bounds += [low, high]
        chunk = np.arange(len(values)) // CHUNK
        span = (high - low)[chunk]
        shares.append(np.divide(values - low[chunk], span, out=np.zeros_like(values), where=span > 0))
    positions, sizes, colors = shares
    largest, others = smallest_three(shown.quats)
    turned = _words(0.5 + others * np.float32(np.sqrt(0.5)), (10, 10, 10)) | largest.astype(np.uint32) << np.uint32(30)
    rgba = np.concatenate([colors, shown.opacities[:, None]], axis=1)
    words = [_words(positions, (11, 10, 11)), turned, _words(sizes, (11, 10, 11)), _words(rgba, (8, 8, 8, 8))]
    return np.concatenate(bounds, axis=1), np.stack(words, axis=1)


def _words(shares: NDArray[np.float32], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Shares in [0, 1], [M, len(bits)], side by side in one word [M]; the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in enumerate(bits):
        steps = (1 << width) - 1
        word = word << np.uint32(width) | np.rint(np.clip(shares[:, column], 0, 1) * steps).astype(np.uint32)
    return word
