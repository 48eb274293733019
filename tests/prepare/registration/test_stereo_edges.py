"""Depths of edges, from disparities that are noisy."""

import numpy as np
import pytest

from thermosplat.prepare.registration.stereo_edges import chosen_edges, contour_strength, front_disparity


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


def test_a_faint_contour_counts_more_than_strong_grain() -> None:
    """A road that is 15 grey levels lighter than asphalt whose grain has a deviation of 15."""
    grain = np.random.default_rng(0).normal(0, 15, (120, 160, 3))
    photograph = (grain + np.where(np.arange(160) < 80, 100, 115)[:, None]).clip(0, 255).astype(np.uint8)
    strength = contour_strength(photograph)
    assert np.median(strength[10:-10, 78:82]) > 2 * np.median(strength[10:-10, 10:60])


def test_half_of_the_points_are_on_outlines_and_the_others_on_contours() -> None:
    """Each once; the steeper it is the likelier; all of them where they are few."""
    outline, strength = np.arange(1000) < 300, np.where(np.arange(1000) % 2, 3.0, 1.0).astype(np.float32)
    chosen = chosen_edges(outline, strength, 200)
    assert len(np.unique(chosen)) == 200
    assert outline[chosen].sum() == 100
    assert 60 < (strength[chosen[~outline[chosen]]] > 2).sum() < 90  # 75 of 100 are expected
    assert sorted(chosen_edges(outline, strength, 5000)) == list(range(1000))
    assert len(chosen_edges(np.zeros(50, bool), np.zeros(50, np.float32), 20)) == 20


@pytest.mark.parametrize("count", [0, 50])
def test_photographs_without_plain_edges_have_what_outlines_they_have(count: int) -> None:
    """A dark photograph has no edge at all, one of a thing before a wall may have its outline alone."""
    assert len(chosen_edges(np.ones(count, bool), np.ones(count, np.float32), 20)) == min(count, 20)
