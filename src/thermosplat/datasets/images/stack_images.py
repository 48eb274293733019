"""Stacks of channels as training images: the few coordinates of each pixel in a basis, and what they leave out.

However many channels there are, a pixel becomes ``LATENT`` coordinates c in an orthonormal basis B of the channels, and
one number r for the rest. Since |x - B'z|² = |c - z|² + r², errors of all channels come of these without the channels.
Bands are divided by the root of their number, so that squares are means over bands; of features directions count alone.

An image holds (c + 1) / 2 and r, all in [0, 1].
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.frame_files import Shot
from thermosplat.datasets.images.masks import joined, read_mask
from thermosplat.datasets.images.pixel_meaning import PixelMeaning, SpectrumPixels
from thermosplat.datasets.images.spectrum_images import SpectrumReading
from thermosplat.datasets.images.stack_files import read_stack
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.spectra import COUNTS, LATENT, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale

_SAMPLED = 1 << 18
"""Numbers of a file that the basis is found of: so many pixels times channels."""
_HIGHEST = 99.9
"""Percentile of bands that becomes 1 where no range is given; others are clipped."""
_ORTHONORMAL = 1e-3


def read_stacks(shots: Sequence[Shot | None], config: SpectrumConfig) -> SpectrumReading:
    """The stacks of a spectrum.

    Args:
        shots: By frame, at least one.

    Raises:
        UserError: A file is not what the settings say.
    """
    with ThreadPoolExecutor() as pool:
        present = [shot for shot in shots if shot is not None]
        samples = np.concatenate(list(pool.map(lambda shot: _sample(read_stack(shot.path, config.channels)), present)))
        ends = _ends(samples, config)
        basis = _basis(_normal(samples, config, ends), config)
        scale = PixelScale("stack", range=ends, basis=basis)

        def pixels(shot: Shot | None) -> SpectrumPixels | None:
            return None if shot is None else _pixels(shot, config, ends, basis)

        meaning = PixelMeaning("stack", scale, COUNTS, config.factor, ends)
        return SpectrumReading(meaning, tuple(pool.map(pixels, shots)), ())


def _sample(stack: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels [n, C] spread over a stack."""
    flat = stack.reshape(-1, stack.shape[-1])
    return flat[:: -(-flat.size // _SAMPLED)]


def _ends(samples: NDArray[np.float32], config: SpectrumConfig) -> tuple[float, float]:
    """Values of bands that become 0 and 1."""
    if config.source == "features":
        return 0.0, 1.0
    if config.range is not None:
        return config.range
    low, high = min(0.0, float(samples.min())) * config.factor, float(np.percentile(samples, _HIGHEST)) * config.factor
    return low, high if high > low else low + 1.0


def _normal(stack: NDArray[np.float32], config: SpectrumConfig, ends: tuple[float, float]) -> NDArray[np.float32]:
    """Channels [..., C] of length 1 at most: directions of features, bands by their range and number."""
    if config.source == "features":
        lengths = np.linalg.norm(stack, axis=-1, keepdims=True)
        return stack / np.maximum(lengths, np.float32(1e-12))
    low, high = ends
    shares = np.clip((stack * np.float32(config.factor) - low) / (high - low), 0, 1)
    return np.asarray(shares / np.sqrt(config.channels), np.float32)


def _basis(samples: NDArray[np.float32], config: SpectrumConfig) -> NDArray[np.float32]:
    """Orthonormal rows, [LATENT, C]; zeros where there are fewer channels."""
    basis = np.zeros((LATENT, config.channels), np.float32)
    if config.basis is not None:
        rows = _read_basis(Path(config.basis).expanduser(), config.channels)
    else:
        wide = samples.astype(np.float64)
        _, vectors = np.linalg.eigh(wide.T @ wide)  # rising
        rows = vectors[:, ::-1].T[:LATENT]
        rows = rows * np.where(rows.sum(axis=1, keepdims=True) < 0, -1, 1)  # either sign is as good: one that stays
    basis[: len(rows)] = rows
    return basis


def _read_basis(path: Path, channels: int) -> NDArray[np.float32]:
    try:
        rows = np.load(BytesIO(read_regular(path)), allow_pickle=False).astype(np.float32)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"The basis {path} cannot be read.", "Expected is a .npy file.") from error
    products = rows @ rows.T if rows.ndim == 2 and rows.shape[1] == channels else np.zeros((0, 0))
    # a basis that was found of fewer channels has rows of zeros
    if not 1 <= len(products) <= LATENT or np.abs(products - np.diag(np.diag(products) > 0.5)).max() > _ORTHONORMAL:
        raise UserError(
            f"{path} holds {list(rows.shape)} numbers, which are no basis of {channels} channels.",
            f"Expected are 1 to {LATENT} orthonormal rows: numpy.linalg.qr makes them.",
        )
    return rows


def _pixels(
    shot: Shot, config: SpectrumConfig, ends: tuple[float, float], basis: NDArray[np.float32]
) -> SpectrumPixels:
    stack = read_stack(shot.path, config.channels)
    height, width = stack.shape[:2]
    there = np.any(stack != 0, axis=-1) if config.source == "features" else None
    mask = joined([there, None if shot.mask is None else read_mask(shot.mask, width, height)])
    normal = _normal(stack, config, ends)
    coordinates = normal @ basis.T
    left = normal - coordinates @ basis  # from a difference of squares, rest would be wrong by 5e-4
    rest = np.linalg.norm(left, axis=-1, keepdims=True)
    return SpectrumPixels(np.concatenate([(coordinates + 1) / 2, rest], axis=-1, dtype=np.float32), None, mask)
