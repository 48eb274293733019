"""Depths of held-out views against true ones, and the tables that tell of them."""

from pathlib import Path

import numpy as np

from measuring.markdown_table import markdown_table
from scenes.held_out_depths import HeldOut
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import View
from thermosplat.datasets.ground_truth import GroundTruth

OWN = np.array([[2.0, 4.0, 0.0, 10.0]])
OTHER = np.array([[2.0, 5.0, 3.0, 10.05]])


def a_view() -> HeldOut:
    """Four pixels: one surface, two, sky in this spectrum, and two nearly the same."""
    camera = Camera(10.0, 10.0, 2.0, 0.5, 4, 1)
    view = View("rgb", "a", Path("a.png"), camera, np.eye(4), np.zeros((1, 4, 3), np.uint8))
    return HeldOut(view, GroundTruth({"rgb": OWN.astype(np.float32)}, np.zeros((1, 4), np.uint8)), OWN, OTHER)


def test_surfaces_differ_by_a_share_of_the_depth() -> None:
    """More than a hundredth, and only where both are known."""
    assert a_view().differs.tolist() == [[False, True, False, False]]
    assert [a_view().differing(label).any() for label in (0, 1)] == [True, False]


def test_errors_are_of_pixels_with_a_true_depth() -> None:
    """And relative to it."""
    np.testing.assert_allclose(a_view().relative_errors(np.array([[3.0, 3.0, 7.0, 10.0]])), [0.5, 0.25, 0.0])


def test_a_depth_lies_on_the_nearer_surface() -> None:
    """No depth, 0, lies on none."""
    seen = [a_view().on_own_surface(np.full((1, 4), depth))[0, 1] for depth in (4.2, 4.8, 0.0)]
    assert seen == [True, False, False]


def test_a_table_leaves_empty_what_a_row_lacks() -> None:
    """Columns and their forms are as given."""
    rows = [{"name": "desk", "share": 0.125}, {"name": "lab"}]
    lines = markdown_table(rows, {"name": "{}", "share": "{:.1%}"}).splitlines()
    assert lines == ["| name | share |", "|---|---|", "| desk | 12.5% |", "| lab |  |"]
