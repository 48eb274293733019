"""How alike photographs look, from the features that they have already: vectors of locally aggregated descriptors.

Jégou et al. 2010 (VLAD), with the normalisation by word of Arandjelović and Zisserman 2013. The words come from the
photographs themselves, so nothing has to be downloaded, as COLMAP's vocabulary trees have to be.
"""

from collections.abc import Sequence

import cv2  # before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

WORDS = 64
"""As Jégou et al."""
_SAMPLE = 20_000
"""Descriptors from which the words are found: 300 for each."""


def likeness(database: pycolmap.Database, image_ids: Sequence[int]) -> NDArray[np.float32]:
    """Cosines between the photographs' vectors, [N, N]."""
    drawn = np.random.default_rng(0)
    each = -(-_SAMPLE // len(image_ids))
    sample = []
    for image_id in image_ids:
        descriptors = _descriptors(database, image_id)
        sample.append(descriptors[drawn.permutation(len(descriptors))[:each]])
    training = np.concatenate(sample)
    if len(training) < WORDS:
        return np.zeros((len(image_ids), len(image_ids)), np.float32)
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, 15, 0.0)
    words = cv2.kmeans(training, WORDS, None, criteria, 1, cv2.KMEANS_PP_CENTERS)[2]
    vectors = np.stack([_vector(_descriptors(database, image_id), words) for image_id in image_ids])
    return vectors @ vectors.T


def _descriptors(database: pycolmap.Database, image_id: int) -> NDArray[np.float32]:
    stored = database.read_descriptors(image_id)
    return np.asarray(getattr(stored, "data", stored)).reshape(-1, 128).astype(np.float32)


def _vector(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """The vector of one photograph, of length 1."""
    nearest = ((words**2).sum(axis=1) - 2 * descriptors @ words.T).argmin(axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)
