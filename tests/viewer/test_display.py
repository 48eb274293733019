"""Values become the colours of their palette; ranges, isotherms, thresholds, wipe and blend do what they say."""

import numpy as np
import pytest

from thermosplat.thermal.radiometry import FLIR_IRON, GREY
from thermosplat.viewer.display import Display, compared, isotherms, picture_range
from thermosplat.viewer.layers import Layer, LayerImage

RAMP = np.linspace(10, 30, 201, dtype=np.float32)[None].repeat(40, axis=0)


def layer(field: np.ndarray = RAMP, span: tuple[float, float] | None = (10.0, 30.0)) -> LayerImage:
    return LayerImage(Layer("image", "thermal"), field, None, FLIR_IRON, span, "°C", "temperature")


def test_a_value_has_its_palettes_color() -> None:
    """In the middle of the range is the middle of the palette, within one level."""
    for display in (Display(), Display("white hot"), Display("viridis", "locked", (0.0, 40.0))):
        picture = display.picture(layer())
        low, high = display.range_of(layer())
        expected = 255 * display.palette_of(layer()).to_color((RAMP[0] - low) / (high - low))
        assert np.abs(picture[0] - expected).max() <= 1.5


def test_ranges_of_the_palette() -> None:
    """The capture's, the picture's percentiles, and locked ones; missing values have no colour of the palette."""
    assert Display().range_of(layer()) == (10.0, 30.0)
    low, high = Display(range_mode="automatic").range_of(layer())
    assert (low, high) == pytest.approx((10.2, 29.8), abs=0.05)
    assert Display().range_of(layer(span=None)) == pytest.approx((10.2, 29.8), abs=0.05)
    assert Display(range_mode="locked", locked=(1.0, 2.0)).range_of(layer()) == (1.0, 2.0)
    holes = RAMP.copy()
    holes[:, 50:] = np.nan
    assert picture_range(holes)[1] < 15.0
    assert len(np.unique(Display().picture(layer(holes))[:, 50:].reshape(-1, 3), axis=0)) == 1
    assert picture_range(np.full((2, 2), np.nan)) == (0.0, 1.0)


def test_isotherms_lie_where_values_pass_a_step() -> None:
    """On a ramp of 0.1 degrees a pixel, lines of 5 degrees lie 50 pixels apart."""
    columns = np.flatnonzero(isotherms(RAMP - 0.05, 5.0)[0])
    np.testing.assert_array_equal(columns, [0, 50, 100, 150])
    plain, lined = Display("white hot").picture(layer()), Display("white hot", isotherms=5.0).picture(layer())
    assert (plain != lined).any(axis=-1)[0].sum() in (3, 4)


def test_a_threshold_greys_the_rest() -> None:
    """Values between the ends keep their colours, all others are grey."""
    shown = Display(threshold=(18.0, 22.0)).picture(layer())[0]
    is_grey = (shown == shown[:, :1]).all(axis=-1)
    inside = (RAMP[0] >= 18) & (RAMP[0] <= 22)
    assert not is_grey[inside].any()
    assert is_grey[~inside].all()


def test_pseudo_colors_are_inverted_only_where_needed() -> None:
    """The capture's palette over the capture's range needs no values; everything else does."""
    assert not Display().needs_values(FLIR_IRON)
    assert not Display("iron").needs_values(FLIR_IRON)
    for display in (Display("iron"), Display(isotherms=1.0), Display(threshold=(0, 1)), Display(range_mode="locked")):
        assert display.needs_values(GREY)


def test_wipe_and_blend() -> None:
    """A wipe has the first up to its edge; a blend mixes; a smaller second picture is brought to size."""
    first, second = np.full((4, 10, 3), 200, np.uint8), np.full((2, 5, 3), 100, np.uint8)
    wiped = compared(first, second, "wipe", 0.3)
    assert (wiped[:, :3] == 200).all()
    assert (wiped[:, 3:] == 100).all()
    assert (compared(first, second, "blend", 0.25) == 175).all()
    assert compared(first, second, "off", 0.5) is first
