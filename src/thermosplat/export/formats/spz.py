"""Gaussians as SPZ, Niantic's compressed format, version 3: one gzip stream of 20 bytes per Gaussian and its harmonics.

By attribute, one after the other: positions in 24-bit fixed point, opacities, colours, log-scales, the three smallest
components of the quaternion, harmonics. The axes are right, up, back: half a turn about x away from the frame of the
capture's poses. Source: the description and the packing rules of https://github.com/nianticlabs/spz.
"""

import gzip
import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.export.formats.packed_quaternions import smallest_three
from thermosplat.export.splats import Splats, WrittenSplats, drawable, morton_order, turned_y_up
from thermosplat.runs.atomic_writes import write_bytes

_MAGIC, _VERSION = 0x5053474E, 3
_MOST_FRACTIONAL_BITS = 20
_COLOR_STEPS = 0.15 * 255.0
"""Steps of a colour's byte for each unit of sh0: room for colours below 0 and above 1 that harmonics bring back."""
_SIZES = (-10.0, 5.9375)
"""Smallest and largest log-scale of a byte."""


def write_spz(path: Path, splats: Splats) -> WrittenSplats:
    """Write Gaussians as SPZ.

    Args:
        path: The file, ``*.spz``.

    Raises:
        UserError: The scene is too large for the format's fixed point, or its Gaussians are too small or too large.
    """
    shown = turned_y_up(drawable(splats))
    _check_sizes(shown.log_scales)
    shown = shown[morton_order(shown.means)]
    fractional = _fractional_bits(shown.means)
    fixed = np.rint(shown.means.astype(np.float64) * (1 << fractional)).astype("<i4")
    parts = [
        np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 4)[:, :3],  # the lowest three bytes
        _bytes(shown.opacities * 255.0),
        _bytes(shown.sh0 * _COLOR_STEPS + 127.5),
        _bytes((shown.log_scales - _SIZES[0]) * 16.0),
        _rotations(shown.quats),
        _bytes(np.rint(shown.shN * 128.0) + 128.0),  # a coefficient after the other, each of three channels
    ]
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(shown), shown.sh_degree, fractional, 0, 0)
    content = header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    write_bytes(path, gzip.compress(content, mtime=0))
    return WrittenSplats(path, len(shown), len(splats.means) - len(shown))


def _fractional_bits(means: NDArray[np.float32]) -> int:
    """As many bits behind the point as leave room for the farthest position in 23 bits and a sign."""
    farthest = float(np.abs(means).max(initial=0.0))
    for bits in range(_MOST_FRACTIONAL_BITS, -1, -1):
        if farthest * (1 << bits) < (1 << 23) - 1:
            return bits
    raise UserError(
        f"SPZ holds positions up to {1 << 23:,} world units from the origin; this scene has one at {farthest:,.0f}.",
        "Export another format: --format ply.",
    )


def _check_sizes(log_scales: NDArray[np.float32]) -> None:
    """Refuse a scene of other units: a few Gaussians beyond the ends of the format are drawn with the size there."""
    middle = float(np.median(log_scales)) if len(log_scales) else 0.0
    if not _SIZES[0] <= middle <= _SIZES[1]:
        low, high = (math.exp(end) for end in _SIZES)
        raise UserError(
            f"SPZ holds Gaussians of {low:.1g} to {high:.0f} world units; half of this scene's are "
            f"{'smaller' if middle < _SIZES[0] else 'larger'} than {math.exp(middle):.1g}.",
            "Export another format: --format ply.",
        )


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _rotations(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Words [M] of wxyz quaternions: the largest of x, y, z, w in two bits, then sign and 9 bits for each other."""
    largest, others = smallest_three(quats[:, [1, 2, 3, 0]])
    word = largest.astype(np.uint32)
    for column in others.T:
        magnitude = np.rint(np.abs(column) * np.sqrt(2.0) * 511.0).clip(0, 511).astype(np.uint32)
        word = word << np.uint32(10) | (column < 0).astype(np.uint32) << np.uint32(9) | magnitude
    return word.astype("<u4")
