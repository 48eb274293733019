"""Band radiance of a black body between 8 and 14 um, and back to its temperature."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLANCK, _LIGHT, _BOLTZMANN = 6.62607015e-34, 299792458.0, 1.380649e-23  # SI, exact since 2019


def _table() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Temperatures from -90 to 500 deg C in steps of 0.25 K, and their radiances [W/m^2/sr]."""
    waves = np.linspace(8e-6, 14e-6, 601)
    celsius = np.arange(-90, 500.01, 0.25)
    exponent = _PLANCK * _LIGHT / (waves * _BOLTZMANN * (celsius[:, None] + 273.15))
    return celsius, np.trapezoid(2 * _PLANCK * _LIGHT**2 / waves**5 / np.expm1(exponent), waves, axis=1)


_CELSIUS, _RADIANCE = _table()


def radiance_of(celsius: Any) -> NDArray[np.float64]:
    """Radiance of a black body [W/m^2/sr]."""
    return np.interp(celsius, _CELSIUS, _RADIANCE)


def temperature_of(radiance: Any) -> NDArray[np.float64]:
    """Apparent temperature [deg C]."""
    return np.interp(radiance, _RADIANCE, _CELSIUS)
