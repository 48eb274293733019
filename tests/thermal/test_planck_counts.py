"""Counts of radiometric cameras into temperatures."""

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.thermal.planck_counts import RadiometricCamera

CONSTANTS = {"r1": 16028.2588, "r2": 0.084141, "b": 1418.7, "f": 1.15, "o": -10430.0}
"""Of a FLIR E6xt."""


def seen_counts(camera: RadiometricCamera, kelvin: float) -> float:
    """The measurement formula forwards: what the camera sees of an object of that temperature."""
    air = camera.air_transmission()
    object_ = camera.emissivity * camera.counts(kelvin) + (1 - camera.emissivity) * camera.counts(camera.reflected)
    before = air * object_ + (1 - air) * camera.counts(camera.air)
    window = camera.window_transmission
    behind = window * before + (1 - window) * camera.counts(camera.window)
    return air * behind + (1 - air) * camera.counts(camera.air)


@pytest.mark.parametrize("emissivity", [1.0, 0.6])
@pytest.mark.parametrize("distance", [0.0, 30.0])
@pytest.mark.parametrize("window_transmission", [1.0, 0.8])
def test_the_formula_is_inverted(emissivity: float, distance: float, window_transmission: float) -> None:
    """Counts that an object of a known temperature causes give that temperature back."""
    camera = RadiometricCamera(
        **CONSTANTS,
        emissivity=emissivity,
        distance=distance,
        window_transmission=window_transmission,
        reflected=283.0,
        air=300.0,
        window=295.0,
        humidity=0.7,
    )
    kelvin = np.array([[260.0, 290.0], [320.0, 600.0]])
    counts = np.vectorize(lambda one: seen_counts(camera, one))(kelvin)
    assert camera.celsius(counts) == pytest.approx(kelvin - 273.15, abs=1e-6)


def test_published_example() -> None:
    """Thermimage's documented call: raw 18109, its camera's constants, everything at 20 °C, no distance."""
    camera = RadiometricCamera(r1=21106.77, r2=0.012545258, b=1501, f=1, o=-7340)
    by_hand = 1501 / np.log(21106.77 / (0.012545258 * (18109 - 7340)) + 1) - 273.15
    assert camera.celsius(np.array([18109]))[0] == pytest.approx(by_hand, abs=1e-9)
    assert 23 < by_hand < 25


def test_air_weakens_and_warms() -> None:
    """At room temperature, 50% humidity and 10 m the air lets through about 98%; more air lets through less."""
    transmissions = [RadiometricCamera(**CONSTANTS, distance=distance).air_transmission() for distance in (0, 20, 200)]
    assert transmissions[0] == 1
    assert 0.97 < transmissions[1] < 0.995
    assert transmissions[2] < transmissions[1]


def test_counts_below_absolute_zero_are_no_temperature() -> None:
    """Dead pixels become NaN, not a wrong number."""
    assert np.isnan(RadiometricCamera(**CONSTANTS).celsius(np.array([0, 10429]))).all()


@pytest.mark.parametrize("wrong", [{"emissivity": 0.0}, {"r1": float("nan")}, {"distance": -1.0}, {"air": 0.0}])
def test_impossible_calibrations(wrong: dict[str, float]) -> None:
    """They are an error, not temperatures."""
    with pytest.raises(UserError, match="calibration is impossible"):
        RadiometricCamera(**{**CONSTANTS, **wrong})
