"""Palettes, their inverse, palette files, and what pixel values mean."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermosplat.errors import UserError
from thermosplat.thermal.radiometry import FLIR_IRON, Palette, PixelScale, load_palette


def nearest_by_search(palette: Palette, colors: np.ndarray) -> np.ndarray:
    """Intensity of the nearest of 20,001 points of the curve."""
    intensity = np.linspace(0, 1, 20001)
    curve = palette.to_color(intensity).astype(np.float64)
    return np.array([intensity[np.argmin(((curve - color) ** 2).sum(-1))] for color in colors])


def test_flir_iron_has_the_published_stops():
    """Entries 0, 32, ..., 224, 255 of the 256 are those read out of FLIR files."""
    levels = np.round(FLIR_IRON.colors * 255)
    assert len(levels) == 256
    np.testing.assert_array_equal(levels[[0, 32, 128, 255]], [(0, 0, 0), (62, 0, 142), (237, 83, 62), (254, 254, 254)])


def test_to_color_interpolates_and_clips():
    """Halfway between two entries is their mean; outside of [0, 1] the end colours hold."""
    palette = Palette(np.array([[0, 0, 0], [1, 0.5, 0], [1, 1, 1]], np.float32))
    got = palette.to_color([-1.0, 0.25, 0.5, 2.0])
    np.testing.assert_allclose(got, [[0, 0, 0], [0.5, 0.25, 0], [1, 0.5, 0], [1, 1, 1]], atol=1e-7)


@settings(deadline=None)  # the first call makes the inverse's table
@given(st.floats(0, 1, width=32))
def test_inverse_undoes_the_palette(intensity: float):
    """to_intensity(to_color(u)) is u."""
    assert FLIR_IRON.to_intensity(FLIR_IRON.to_color(intensity)) == pytest.approx(intensity, abs=2e-6)


@pytest.mark.parametrize("entries", [9, 256])
def test_inverse_is_the_nearest_point_of_the_curve(entries: int):
    """Beside the curve the inverse agrees with an exhaustive search, for coarse and fine palettes."""
    palette = Palette(FLIR_IRON.to_color(np.linspace(0, 1, entries)))
    generator = np.random.default_rng(0)
    truth = generator.random(300)
    colors = np.clip(palette.to_color(truth) + generator.normal(0, 4 / 255, (300, 3)), 0, 1)
    expected = nearest_by_search(palette, colors)
    got = palette.to_intensity(colors)
    assert np.mean(np.abs(got - expected) < 2e-4) > 0.98
    assert np.abs(got - expected).max() < 0.05


def test_inverse_keeps_the_shape_and_takes_any_color():
    """Images give images, and colours far from the curve or out of range still give something in [0, 1]."""
    got = FLIR_IRON.to_intensity(np.random.default_rng(0).uniform(-0.5, 1.5, (5, 7, 3)))
    assert got.shape == (5, 7)
    assert got.dtype == np.float32
    assert got.min() >= 0
    assert got.max() <= 1


def test_inverse_of_levels_is_that_of_their_colors():
    """uint8 levels and the same colours in [0, 1] give the same intensities, pixel by pixel."""
    image = np.random.default_rng(0).integers(0, 8, (9, 11, 3), np.uint8) * 36
    np.testing.assert_array_equal(FLIR_IRON.to_intensity(image), FLIR_IRON.to_intensity(image / np.float32(255)))


def test_residual_is_the_distance_to_the_curve_in_levels():
    """A grey curve is left by 10 levels across it, and not along it."""
    grey = Palette(np.array([[0, 0, 0], [1, 1, 1]], np.float32))
    across = np.array([1, -1, 0]) / np.sqrt(2) * 10 / 255
    assert grey.residual(np.full((4, 3), 0.5) + across) == pytest.approx(10, abs=1e-3)
    assert grey.residual(np.full((4, 3), 0.7)) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("colors", [np.zeros((1, 3)), np.zeros((4, 4)), np.full((4, 3), 2.0), np.full((4, 3), np.nan)])
def test_palette_refuses_what_is_none(colors: np.ndarray):
    """Fewer than two entries, other than three channels, values outside of [0, 1]."""
    with pytest.raises(UserError, match=r"[Pp]alette"):
        Palette(colors)


def test_load_palette_json_and_csv(tmp_path):
    """Both formats give the same palette; a CSV may have a header."""
    rows = [[0, 0, 0], [255, 128, 0], [255, 255, 255]]
    (tmp_path / "p.json").write_text(json.dumps({"lut": rows}))
    (tmp_path / "p.csv").write_text("r,g,b\n" + "\n".join(",".join(map(str, row)) for row in rows))
    palette = load_palette(tmp_path / "p.json", "thermal")
    np.testing.assert_allclose(palette.colors * 255, rows, atol=1e-4)
    assert load_palette(tmp_path / "p.csv", "thermal") == palette


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("form", ["%d", "%.18e", "%+.1f"])
def test_load_palette_keeps_the_first_row(tmp_path, encoding: str, form: str):
    """Numbers as np.savetxt and spreadsheets write them are no column names: the coldest colour stays."""
    rows = np.array([[0, 0, 4], [255, 128, 0], [255, 255, 255]])
    np.savetxt(tmp_path / "p.csv", rows, form, delimiter=",", encoding=encoding)
    np.testing.assert_allclose(load_palette(tmp_path / "p.csv", "thermal").colors * 255, rows, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("p.json", '{"colors": []}', "not a palette"),
        ("p.json", "{", "not a palette"),
        ("p.csv", "1,2\n3,4", "rows of three"),
        ("p.csv", "0,0,0\n300,0,0", "0 to 255"),
        ("p.csv", "0,0,0\n1,x,0", "not a palette"),
    ],
)
def test_load_palette_says_what_is_wrong(tmp_path, name: str, text: str, says: str):
    """A broken palette file is named with what was expected."""
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=says) as caught:
        load_palette(tmp_path / name, "thermal")
    assert str(tmp_path / name) in caught.value.message
    assert "--thermal.palette" in caught.value.hint


def test_load_palette_missing_file(tmp_path):
    """A palette file that does not exist is a UserError with its name."""
    with pytest.raises(UserError, match=r"none\.json"):
        load_palette(tmp_path / "none.json", "thermal")


def test_scale_has_channels_and_values():
    """Photographs and pseudo-colour have three channels, a scalar one; intensity maps linearly onto the range."""
    scale = PixelScale("color", FLIR_IRON, (20.0, 40.0), "celsius")
    assert scale.channels == PixelScale("photograph").channels == 3
    assert PixelScale("scalar").channels == 1
    np.testing.assert_allclose(scale.value(np.array([0.0, 0.25, 1.0])), [20, 25, 40])
    assert scale.measured_unit == "celsius"


def test_scale_without_a_range_refuses_to_invent_values():
    """Without a range nothing can be measured, whatever the unit would be."""
    with pytest.raises(ValueError, match="no range of values"):
        PixelScale("scalar").value(np.zeros(3))
    assert PixelScale("scalar", unit="celsius").measured_unit is None
    assert PixelScale("scalar", range=(0.0, 4095.0)).measured_unit is None


@pytest.mark.parametrize(
    ("span", "unit"),
    [(None, None), (None, "celsius"), ((-5.5, 80.25), "celsius"), ((0.0, 1.0), "reflectance"), ((0.0, 4095.0), None)],
)
def test_scale_survives_a_checkpoint(span: tuple[float, float] | None, unit: str | None):
    """state_dict is plain JSON and restores an equal scale."""
    scale = PixelScale("color", Palette(FLIR_IRON.colors[::16]), span, unit)
    assert PixelScale.from_state_dict(json.loads(json.dumps(scale.state_dict()))) == scale


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.json", '{"lut": [[1, 2, ' + "9" * 400 + "], [1, 2, 3]]}", "is not a palette"),
        ("a.json", '{"lut": [[1, 2, ' + "9" * 5001 + "], [1, 2, 3]]}", "is not a palette"),
        ("a.json", '{"lut": ' + "[" * 100_000 + "]" * 100_000 + "}", "is not a palette"),
        ("a.csv", "1,2,3\n" * 5000, "has 5,000 rows; a palette has 4,096 entries at most"),
        ("a.csv", '"' + "1" * 200_000 + '",2,3\n', "is not a palette"),
        ("a.csv", "1,2,3\n" * 3_000_000, "is not a palette"),
    ],
)
def test_palettes_of_any_size(tmp_path, name, text, says):
    """Long numbers, deep lists and long files end as a sentence."""
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=says):
        load_palette(tmp_path / name, "thermal")
