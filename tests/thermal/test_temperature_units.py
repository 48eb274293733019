"""Units of radiometric values: conversion, judgement, plausibility, statements in files."""

import json

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.thermal.temperature_units import (
    celsius_range,
    check_plausible,
    judge_unit,
    may_be_temperature,
    measured_unit,
    read_json,
    read_statement,
    to_measured,
)


@pytest.mark.parametrize(
    ("unit", "value"),
    [
        *(("kelvin", 300.0), ("decikelvin", 3000), ("centikelvin", 30000), ("millikelvin", 300000)),
        *(("celsius", 26.85), ("decicelsius", 268.5), ("centicelsius", 2685), ("fahrenheit", 80.33)),
    ],
)
def test_every_unit_gives_the_same_temperature(unit, value):
    """300 K in each unit is 26.85 °C."""
    got = to_measured(np.array([value]), unit)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, 26.85, atol=1e-4)


def test_counts_have_no_degrees():
    """Counts give None, not a guess, and have no unit in which an error could be reported."""
    assert to_measured(np.array([8000]), "counts") is None
    assert to_measured(np.array([8000]), "counts", 0.5) is None
    assert measured_unit("counts") is None


@pytest.mark.parametrize("unit", ["kelvin", "centikelvin", "celsius", "centicelsius"])
def test_temperatures_are_reported_in_celsius(unit):
    """Whatever the files hold; a factor is none of theirs."""
    assert measured_unit(unit) == "celsius"
    assert may_be_temperature(unit)
    values = np.array([300.0])
    np.testing.assert_array_equal(to_measured(values, unit, 0.5), to_measured(values, unit))


def test_other_units_keep_their_name():
    """Values times the factor, in float32; nobody takes them for temperatures."""
    got = to_measured(np.array([0, 5000, 10000], np.uint16), "reflectance", 1e-4)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(to_measured(np.array([0.25]), "W/m^2"), [0.25])
    assert measured_unit("reflectance") == "reflectance"
    assert not may_be_temperature("reflectance")
    assert not may_be_temperature("counts")
    assert may_be_temperature("auto")


@pytest.mark.parametrize(
    ("low", "high", "integer", "unit"),
    [
        (29315, 31020, True, "centikelvin"),
        (4478, 4595, True, "counts"),
        (291.0, 310.5, False, "kelvin"),
        (-12.0, 48.0, False, "celsius"),
        (29315.0, 31020.0, False, "centikelvin"),
        (1e6, 2e6, False, "counts"),
    ],
)
def test_judged_units(low, high, integer, unit):
    """Values that nobody explains are taken for the unit in which they are usual temperatures."""
    assert judge_unit(low, high, integer=integer) == unit


def test_impossible_values_name_the_unit_they_look_like():
    """Centikelvin read as Kelvin would be hotter than anything: the hint is the flag that mends it."""
    with pytest.raises(UserError) as caught:
        check_plausible(29315, 31020, "kelvin", "thermal/", "thermal")
    assert "29,315-31,020" in caught.value.message
    assert "look like centikelvin" in caught.value.message
    assert caught.value.hint == "--thermal.unit centikelvin"
    with pytest.raises(UserError) as caught:
        check_plausible(29315, 31020, "kelvin", "lwir/", "lwir")
    assert caught.value.hint == "--lwir.unit centikelvin"


def test_zeros_look_like_no_unit():
    """Files without any measurement are not taken for degrees Celsius."""
    with pytest.raises(
        UserError, match="Values in thermal_raw/ are 0, which read as Centikelvin is impossible"
    ) as caught:
        check_plausible(0, 0, "centikelvin", "thermal_raw/", "thermal")
    assert "celsius" not in str(caught.value).lower()


def test_impossible_values_of_no_unit_may_be_counts():
    """Values that are a temperature in no unit get the hint to train without degrees."""
    with pytest.raises(UserError) as caught:
        check_plausible(4478, 4595, "centikelvin", "thermal_raw/", "thermal")
    assert "--thermal.unit counts" in caught.value.hint


@pytest.mark.parametrize(("low", "high", "unit"), [(250, 1200, "kelvin"), (-90, 30, "celsius"), (0, 1, "counts")])
def test_possible_values_pass(low, high, unit):
    """Hot ingots, a cold sky and counts are not refused."""
    check_plausible(low, high, unit, "thermal/", "thermal")


@pytest.mark.parametrize(
    ("text", "unit"),
    [("centi-Kelvin", "centikelvin"), ("K", "kelvin"), ("degC", "celsius"), ("°C", "celsius"), ("DN", "counts")],
)
def test_statement_spellings(tmp_path, text, unit):
    """units.json may spell its unit in several ways."""
    path = tmp_path / "units.json"
    path.write_text(json.dumps({"unit": text, "palette_min_C": 20, "palette_max_C": 41.5}))
    statement = read_statement(path, "thermal")
    assert statement.unit == unit
    assert statement.palette_celsius == (20.0, 41.5)


def test_missing_statement_states_nothing(tmp_path):
    """No units.json is no error."""
    statement = read_statement(tmp_path / "units.json", "thermal")
    assert statement.unit is None
    assert statement.palette_celsius is None


@pytest.mark.parametrize("text", ['{"unit": "rankine"}', '{"unit": 5}', "[1]", "{"])
def test_bad_statements_are_named(tmp_path, text):
    """An unknown unit, a list, broken JSON: each names the file."""
    path = tmp_path / "units.json"
    path.write_text(text)
    with pytest.raises(UserError, match=r"units\.json"):
        read_statement(path, "thermal")


def test_an_unknown_unit_names_the_spectrums_flag(tmp_path):
    """What the file says is quoted, what is known is listed."""
    path = tmp_path / "units.json"
    path.write_text('{"unit": "rankine"}')
    with pytest.raises(UserError, match=r"'rankine'; known are kelvin, decikelvin, centikelvin, .*counts") as caught:
        read_statement(path, "lwir")
    assert caught.value.hint == "Or say it with --lwir.unit."


@pytest.mark.parametrize(
    "content",
    [
        *({"a": 1}, {"a": "x", "b": 2}, {"a": 3, "b": 2}, {"a": 2, "b": 2}, {"a": 0, "b": float("inf")}),
        *({"a": -1e308, "b": 1e308}, {"a": 0, "b": 1e30}, {"a": -300, "b": 20}, {"a": 0, "b": 10**400}),
    ],
)
def test_bad_ranges_are_named(tmp_path, content):
    """Half a range, words, the wrong order, no span, one without an end, or beyond all temperatures."""
    with pytest.raises(UserError, match=r"bounds\.json"):
        celsius_range(content, tmp_path / "bounds.json", "a", "b")


def test_read_json_missing_file(tmp_path):
    """A missing JSON file is a UserError."""
    with pytest.raises(UserError, match="not readable"):
        read_json(tmp_path / "none.json")
