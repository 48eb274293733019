"""The comparison pictures: what lies where."""

import numpy as np

from thermosplat.pictures.comparison_strips import GAP, HEADER_HEIGHT, Comparison, comparison_strip
from thermosplat.pictures.image_display import error_bytes


def comparison(width: int, height: int, truth: int = 50, render: int = 90) -> Comparison:
    images = [np.full((height, width, 3), level, np.uint8) for level in (truth, render)]
    return Comparison("RGB", "20.00 dB", *images, np.full((height, width), 0.1), 0.25)


def test_panels_are_truth_render_error() -> None:
    """Three panels under their titles: ground truth, render, error."""
    strip = comparison_strip([comparison(300, 200)])
    assert strip.shape == (HEADER_HEIGHT + 200, 3 * 300 + 2 * GAP, 3)
    panels = [strip[HEADER_HEIGHT:, start : start + 300] for start in (0, 300 + GAP, 600 + 2 * GAP)]
    assert (panels[0] == 50).all()
    assert (panels[1] == 90).all()
    np.testing.assert_array_equal(panels[2][0, 0], error_bytes(np.array([[0.1]]), 0.25)[0, 0])
    for start in (0, 300 + GAP, 600 + 2 * GAP):
        assert strip[:HEADER_HEIGHT, start : start + 300].max() > 200, "no title"


def test_rows_of_different_sizes_get_one_width() -> None:
    """A small thermal image is enlarged to the RGB panel's width, keeping its aspect."""
    strip = comparison_strip([comparison(320, 240), comparison(160, 128, truth=10)])
    assert strip.shape == (2 * HEADER_HEIGHT + GAP + 240 + 256, 3 * 320 + 2 * GAP, 3)
    assert (strip[-256:, :320] == 10).all()


def test_tiny_images_are_enlarged_for_their_titles() -> None:
    """Panels are never narrower than a title."""
    assert comparison_strip([comparison(24, 18)]).shape[1] == 3 * 240 + 2 * GAP
