"""Codebooks: few values or vectors that stand for many (Lloyd's k-means)."""

import numpy as np
import torch
from numpy.typing import NDArray

_PASSES_OF_VALUES, _PASSES_OF_VECTORS = 20, 8
_SEED = 0


def value_codebook(values: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """A codebook of numbers by Lloyd's algorithm, from the quantiles of the values.

    Args:
        values: Any shape, at least one value.

    Returns:
        The entries in ascending order, [size], and the nearest entry of each value, of the shape of ``values``.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    quantiles = ordered[np.linspace(0, len(ordered) - 1, size).astype(int)]
    book = (quantiles + np.linspace(ordered[0], ordered[-1], size)) / 2  # tails have few values and large errors
    for _ in range(_PASSES_OF_VALUES):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), book)
    book = book.astype(np.float32)
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, values)


def vector_codebook(vectors: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """A codebook of vectors in two levels: groups first, then entries in each group, shared out by the groups' sizes.

    Two levels of √size entries each cost √size as many distances as one level of all entries.

    Args:
        vectors: [M, d], M >= 1.
        size: Entries at most, 1 to 65,536.

    Returns:
        The entries, [at most size, d], and the entry of each vector, [M].
    """
    generator = torch.Generator().manual_seed(_SEED)
    points = torch.from_numpy(np.ascontiguousarray(vectors, np.float32))
    groups = _nearest(points, _means(points, max(1, round(size**0.5)), generator))
    labels = np.zeros(len(points), np.intp)
    entries: list[torch.Tensor] = []
    left, waiting, used = size, len(points), 0
    for group in groups.unique().tolist():
        members = (groups == group).nonzero()[:, 0]
        share = max(1, int(left * len(members) / waiting))
        left, waiting = left - share, waiting - len(members)
        own = _means(points[members], share, generator)
        labels[members.numpy()] = used + _nearest(points[members], own).numpy()
        entries.append(own)
        used += len(own)
    return torch.cat(entries).numpy(), labels


def _means(points: torch.Tensor, size: int, generator: torch.Generator) -> torch.Tensor:
    """Centres of at most ``size`` clusters, [K, d]."""
    if len(points) <= size:
        return points.clone()
    centres = points[torch.randperm(len(points), generator=generator)[:size]].clone()
    for _ in range(_PASSES_OF_VECTORS):
        labels = _nearest(points, centres)
        counts = torch.bincount(labels, minlength=size)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, labels, points)
        centres = torch.where(counts > 0, sums / counts.clamp(min=1), centres)
    return centres


def _nearest(points: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Index of the nearest centre to each point, [M]; distances of 4 Mi pairs at once."""
    chunk = max(1, (1 << 22) // len(centres))
    return torch.cat([torch.cdist(part, centres).argmin(dim=1) for part in points.split(chunk)])
