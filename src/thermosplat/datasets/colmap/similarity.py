"""Similarities between corresponding points: the one that most agree on, and that of least weighted squares."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def ransac_similarity(
    source: Array, target: Array, within: float, trials: tuple[int, int] | None = None
) -> Array | None:
    """The similarity [3, 4] that most points agree on (pycolmap, LO-RANSAC), the same in every run.

    Args:
        source: Points [N, 3].
        target: Where they are to be, [N, 3].
        within: Distance up to which a point agrees.
        trials: The fewest and the most that are tried; None: pycolmap's.

    Returns:
        None where none fits.
    """
    import pycolmap

    options = pycolmap.RANSACOptions(max_error=within, random_seed=0)
    if trials is not None:
        options.min_num_trials, options.max_num_trials = trials
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    similarity = found["tgt_from_src"] if isinstance(found, dict) else found
    return None if similarity is None else np.array(similarity.matrix(), np.float64)


def similarity_by_weights(source: Array, target: Array, weights: Array) -> Array:
    """The similarity [3, 4] of least weighted squares (Umeyama 1991).

    Args:
        source: Points [N, 3].
        target: Where they are to be, [N, 3].
        weights: Of each, [N], not all 0.
    """
    weights = weights / weights.sum()
    source_middle, target_middle = weights @ source, weights @ target
    a, b = source - source_middle, target - target_middle
    u, sizes, v = np.linalg.svd((b * weights[:, None]).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = (u * signs) @ v
    scale = float((sizes * signs).sum() / (weights @ (a**2).sum(axis=1)))
    return np.column_stack([scale * rotation, target_middle - scale * rotation @ source_middle])
