"""The legend of a picture: round numbers beside the palette."""

import numpy as np
import pytest

from thermosplat.pictures.color_bar import color_bar, tick_labels, tick_values
from thermosplat.thermal.radiometry import FLIR_IRON


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(20.0, 41.5, ["20", "25", "30", "35", "40"]), (0.0, 1.0, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"])],
)
def test_ticks_are_round_numbers(low: float, high: float, ticks: list[str]) -> None:
    """Multiples of 1, 2, 2.5 or 5 times a power of ten, inside the range."""
    assert tick_labels(tick_values(low, high)) == ticks


def test_ticks_of_odd_ranges() -> None:
    """Quarters have their digits; an empty range has one tick; a falling one is ticked as well."""
    assert tick_labels(tick_values(0.0, 1.0, 5)) == ["0.00", "0.25", "0.50", "0.75", "1.00"]
    assert tick_values(3.0, 3.0) == [3.0]
    assert tick_values(4.0, 0.0) == tick_values(0.0, 4.0)


def test_a_color_bar_shows_its_palette() -> None:
    """Hot on top, cold below, of the height that was asked for."""
    bar = color_bar(FLIR_IRON, 20.0, 41.5, "°C", 300)
    assert bar.shape[0] == 300
    column = bar[:, bar.shape[1] // 4].astype(int).sum(axis=-1)
    inside = column[27:284]
    assert inside[0] > 600
    assert inside[-1] < 20
    assert (np.diff(inside) <= 2).all()  # levels are rounded, channel by channel
