"""Temperatures recalculated: what was applied is undone, something else applied, as FLIR's own programs do."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermosplat.config.temperature_settings import LabelledSurface, TemperatureSettings
from thermosplat.prepare.importing.flir_files import read_flir
from thermosplat.thermal.long_wave_band import LONG_WAVE_BAND
from thermosplat.thermal.recalculation import Recalculation
from thermosplat.thermal.thermal_parameters import CaptureParameters, ThermalParameters

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
FLIR = ThermalParameters(
    applied=True,
    emissivity=0.95,
    reflected_celsius=21.0,
    distance_metres=2.0,
    air_celsius=14.0,
    humidity=0.49,
    window_celsius=19.0,
    window_transmission=0.98,
    planck={"r1": 14866.513671875, "r2": 0.01108647882938385, "b": 1395.7, "f": 1.0, "o": -5859.0},
)
"""As a FLIR E40 states them."""


def recalculation(said: ThermalParameters | None = FLIR, **asked: float) -> Recalculation:
    parameters = None if said is None else CaptureParameters(said)
    return Recalculation.of(parameters, TemperatureSettings(**asked))


@pytest.mark.parametrize("name", ["FLIR_AX8", "FLIR_B60", "FLIR_E40", "FLIR_T640"])
@pytest.mark.parametrize(
    ("asked", "flyrs"),
    [
        ({"emissivity": 0.80}, {"emissivity": 0.80}),
        ({"emissivity": 0.9, "reflected": 5.0}, {"emissivity": 0.9, "reflected_apparent_temperature": 278.15}),
        ({"air": 30.0, "humidity": 0.9}, {"atmospheric_temperature": 303.15, "relative_humidity": 0.9}),
        ({"window": 0.85}, {"ir_window_transmission": 0.85}),
    ],
)
def test_real_files_move_as_flyr_moves_them(name: str, asked: dict[str, float], flyrs: dict[str, float]) -> None:
    """Within 0.05 °C; what flyr has no number for, such as a cold sky at a low emissivity, is left as it is."""
    flyr = pytest.importorskip("flyr")
    path = DATA / "real_files" / f"{name}.jpg"
    if not path.is_file():
        pytest.skip(f"no real_files/{name}.jpg in the shared data folder (THERMOSPLAT_TEST_DATA)")
    image = read_flir(path)
    made = recalculation(ThermalParameters.of_camera(image.camera), **asked).celsius(image.celsius)
    with np.errstate(invalid="ignore"):
        theirs = flyr.unpack(str(path)).adjust_metadata(**flyrs).celsius
    np.testing.assert_array_equal(made.changed, np.isfinite(theirs))
    assert made.changed.mean() > 0.6
    np.testing.assert_allclose(made.celsius[made.changed], theirs[made.changed], atol=0.05)


def test_golden_numbers() -> None:
    """What flyr 5 gives for an E40's counts of 12.0, 25.0 and 80.0 °C after 0.95 has become 0.80, at 2 m."""
    made = recalculation(emissivity=0.80).celsius([12.0, 25.0, 80.0])
    np.testing.assert_allclose(made.celsius, [10.2166, 25.7336, 88.8417], atol=1e-3)


@pytest.mark.parametrize("said", [FLIR, replace(FLIR, planck=None)])
def test_to_ask_for_what_was_applied_changes_nothing(said: ThermalParameters) -> None:
    """The same number comes back."""
    celsius = np.linspace(-20, 150, 18)
    same = recalculation(said, emissivity=0.95, reflected=21.0)
    np.testing.assert_allclose(same.celsius(celsius).celsius, celsius, atol=1e-6)


def test_a_black_body_law_without_constants() -> None:
    """Between 8 and 14 µm a body of 300 K has 55.2 W/m² sr; the law is inverted from -150 to 2000 °C."""
    wavelengths = np.linspace(8e-6, 14e-6, 4001)
    planck = 1.191042972e-16 / wavelengths**5 / np.expm1(0.01438776877 / (wavelengths * 300.0))
    assert LONG_WAVE_BAND.counts(300.0) == pytest.approx(np.trapezoid(planck, wavelengths), rel=1e-5)
    kelvin = np.linspace(123, 2273, 100)
    np.testing.assert_allclose(LONG_WAVE_BAND.kelvin(LONG_WAVE_BAND.counts(kelvin)), kelvin, atol=1e-9)
    assert np.isnan(LONG_WAVE_BAND.kelvin([-1.0, 0.0])).all()


def test_each_pixel_has_its_own_path() -> None:
    """Through more air a hot object looks colder, so more is made up for; unknown distances are the file's."""
    made = recalculation(air=10.0, humidity=0.8).celsius([60.0] * 4, [1.0, 20.0, 100.0, np.nan])
    near, further, far, unknown = made.celsius
    assert near < further < far
    assert far - near > 2.0
    assert unknown == pytest.approx(recalculation(air=10.0, humidity=0.8).celsius(60.0, 2.0).celsius)


def test_without_a_word_of_the_air_there_is_none() -> None:
    """A capture that says nothing is of black bodies right before the lens, and a note says so."""
    made = recalculation(None, emissivity=0.9)
    np.testing.assert_array_equal(made.celsius(30.0, 50.0).celsius, made.celsius(30.0).celsius)
    assert any("black bodies" in note for note in made.notes)
    assert any("--reflected" in note for note in made.notes)


@pytest.mark.parametrize(
    ("surface", "why"),
    [
        (LabelledSurface("chrome", TemperatureSettings(), mirror=True), "chrome: not recalculated, since it mirrors"),
        (LabelledSurface("foil", TemperatureSettings(emissivity=0.3)), "foil: not recalculated, .* emissivity is 0.3"),
    ],
)
def test_what_mirrors_is_not_recalculated(surface: LabelledSurface, why: str) -> None:
    """Its pixels keep the capture's numbers, are not marked, and it says why; others are recalculated by label."""
    wall = LabelledSurface("wall", TemperatureSettings(emissivity=0.9))
    labels = np.array([[0, 1], [2, 2]])
    made = replace(recalculation(None, reflected=15.0, emissivity=0.8), surfaces={1: surface, 2: wall})
    done = made.celsius(np.full((2, 2), 30.0), None, labels)
    assert done.changed.tolist() == [[True, False], [True, True]]
    assert done.celsius[0, 1] == 30.0
    assert done.celsius[0, 0] > done.celsius[1, 0] > 30.0
    assert len(done.reasons) == 1
    assert re.match(why, done.reasons[0])


def test_a_low_emissivity_for_the_whole_scene() -> None:
    """Nothing is recalculated, and it says why."""
    done = recalculation(None, emissivity=0.49).celsius([10.0, 20.0])
    assert not done.changed.any()
    assert done.celsius.tolist() == [10.0, 20.0]
    assert "below 0.5" in done.reasons[0]


def test_impossible_reflections_leave_the_number() -> None:
    """An object that is colder than the reflection alone has no temperature: its pixel keeps what was measured."""
    done = recalculation(None, emissivity=0.5, reflected=120.0).celsius([-20.0, 100.0])
    assert done.changed.tolist() == [False, True]
    assert done.celsius[0] == -20.0
    assert "colder" in done.reasons[0]
