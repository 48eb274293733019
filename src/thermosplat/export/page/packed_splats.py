"""Gaussians as few bytes for the page: what ``unpack.js`` reads.

Positions have 16 bits between the bounds of their 256 neighbours on a Morton curve, logarithms of scales steps of
1/128, opacities of 1/4095: with a codebook of 256 scales and 8 bits of opacity, a tenth of lab's pixels differed by 0.3
°C. Quaternions are their three smallest components of 8 bits, colours indices into a codebook of 256 numbers, their
harmonics an index into a palette of vectors, as in SOG. A spectrum of values has one channel, of 16 bits, and its own
harmonics. Columns lie one after the other, which gzip likes, and the wide numbers first, which need aligned places.
"""

import gzip
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.export.formats.codebooks import value_codebook, vector_codebook
from thermosplat.export.formats.packed_quaternions import smallest_three
from thermosplat.export.splats import Splats, drawable, morton_order

CHUNK = 256
"""Gaussians that share bounds."""
SCALE_STEPS, OPACITY_STEPS = 128, 4095
_BOOK = 256
_MOST_ENTRIES = 65_536
"""Of the palette of harmonics: those that 16 bits tell apart."""


def packed(splats: Splats, channels: int) -> tuple[dict[str, Any], bytes]:
    """Gaussians for the page.

    Args:
        splats: In the page's frame; those that cannot be seen are left out.
        channels: 3 of colours, 1 of a value, which is the mean of the three.

    Returns:
        What the page has to know of them, and the compressed bytes.

    Raises:
        UserError: None can be seen.
    """
    shown = drawable(splats)
    if len(shown) == 0:
        raise UserError("No Gaussian of this run can be seen, so a page would be empty.", "Train for longer.")
    shown = shown[morton_order(shown.means)]
    count, bases = len(shown), shown.shN.shape[1]
    bounds, positions = _positions(shown.means)
    smallest = float(shown.log_scales.min())
    scales = np.minimum(np.rint((shown.log_scales - smallest) * SCALE_STEPS), 65535)
    largest, others = smallest_three(shown.quats)
    quats = np.concatenate([np.rint((0.5 + others * np.sqrt(0.5)) * 255.0), largest[:, None]], axis=1)
    books: list[NDArray[np.generic]] = [bounds]
    narrow: list[NDArray[np.generic]] = [quats.T]
    wide: list[NDArray[np.generic]] = [positions.T, scales.T, np.rint(shown.opacities * OPACITY_STEPS)]
    described: dict[str, Any] = {"count": count, "bases": bases, "channels": channels, "entries": 0}
    described["smallest"] = smallest
    if channels == 1:
        level = shown.sh0.mean(axis=1)
        low, high = float(level.min()), float(level.max())
        described["level"] = (low, high)
        wide.append(np.rint((level - low) / max(high - low, 1e-12) * 65535.0))
        harmonics = shown.shN.mean(axis=2)
    else:
        color_book, colors = value_codebook(shown.sh0, _BOOK)
        books.append(color_book)
        narrow.append(colors.T)
        harmonics = shown.shN.reshape(count, -1)
    if bases:
        if channels == 3:
            harmonics, labels = vector_codebook(harmonics, min(_MOST_ENTRIES, count))
            wide.append(labels)
        book, indices = value_codebook(harmonics, _BOOK)
        books.append(book)
        narrow.append(indices.T)
        described["entries"] = len(harmonics)
    parts = [(part, kind) for kind, some in (("<f4", books), ("<u2", wide), ("u1", narrow)) for part in some]
    content = b"".join(np.ascontiguousarray(part, kind).tobytes() for part, kind in parts)
    return described, gzip.compress(content, 9, mtime=0)


def _positions(means: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of each chunk, [chunks, 6], least and largest, and places between them in 16 bits, [M, 3]."""
    starts = np.arange(0, len(means), CHUNK)
    low, high = (kind.reduceat(means.astype(np.float64), starts) for kind in (np.minimum, np.maximum))
    of_each = np.arange(len(means)) // CHUNK
    shares = (means - low[of_each]) / np.maximum(high - low, 1e-12)[of_each]
    return np.concatenate([low, high], axis=1), np.rint(shares * 65535.0)
