"""Depths of edges, from disparities that are noisy."""

import numpy as np

from thermosplat.prepare.registration.stereo_edges import front_disparity


def test_noise_brings_no_edge_nearer() -> None:
    """On a slanted wall the mean is that of the wall, where the largest of each block is 0.6 px larger."""
    rows, columns = np.mgrid[0:60, 0:80]
    wall = 30 + 0.1 * columns
    noisy = (wall + np.random.default_rng(0).normal(0, 0.25, wall.shape)).astype(np.float32)
    at = np.column_stack([columns[5:-5, 5:-5].ravel(), rows[5:-5, 5:-5].ravel()])
    assert abs(np.mean(front_disparity(noisy, at) - wall[at[:, 1], at[:, 0]])) < 0.05


def test_an_outline_belongs_to_what_is_in_front() -> None:
    """Up to two pixels beside a step; nothing is known farther away, nor where no disparity is."""
    disparity = np.full((20, 20), 20.0, np.float32)
    disparity[:, 10:] = 30.0
    disparity[:, :5] = 0.0
    at = np.array([[12, 10], [10, 10], [8, 10], [7, 10], [1, 10], [6, 0]])
    assert front_disparity(disparity, at).tolist() == [30.0, 30.0, 30.0, 20.0, 0.0, 20.0]
