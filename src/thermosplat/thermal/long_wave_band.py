"""The signal of a camera whose constants nobody knows: a black body's radiance between 8 and 14 µm.

    L(T) = ∫ 2 h c² / (λ⁵ (exp(h c / (λ k T)) - 1)) dλ    [W / (m² sr)]

That is the band of uncooled bolometers (ISO 20473 calls it thermal infrared; FLIR states 7.5 to 13 or 14 µm for most of
its cameras). Source: Planck's law with the exact constants of the SI since 2019. Five constants R1, R2, B, F, O that
are fitted to this band are off by 0.1 °C at 100 °C after ε = 0.95 has become 0.80; so the integral itself is kept, as a
table in which one looks up both ways.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_H, _C, _K = 6.62607015e-34, 299_792_458.0, 1.380649e-23
_BAND = (8e-6, 14e-6)
_COLDEST, _HOTTEST = 60.0, 4000.0
"""Ends of the table [K]."""
_ENTRIES = 8192
"""Of the table, equally spaced in 1/T, in which the logarithm of L is almost straight: linear between them, L is off by
less than 1e-6 of itself."""


class LongWaveBand:
    """A ``Law`` (``planck_counts``) of black bodies between 8 and 14 µm."""

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """1/T, falling, and the logarithm of L(T), rising."""
        inverse = np.linspace(1 / _COLDEST, 1 / _HOTTEST, _ENTRIES)
        wavelengths = np.linspace(*_BAND, 601)
        radiance = np.zeros(_ENTRIES)
        weights = np.gradient(wavelengths)
        weights[[0, -1]] /= 2  # trapezoids: ends count half
        for wavelength, weight in zip(wavelengths, weights, strict=True):
            radiance += weight / (wavelength**5 * np.expm1(_H * _C / (wavelength * _K) * inverse))
        return inverse, np.log(2 * _H * _C**2 * radiance)

    def counts(self, kelvin: Any) -> Array:
        """Radiance of a black body [W / (m² sr)], [...]; NaN outside of 60 to 4,000 K.

        Args:
            kelvin: Its temperature [K], [...].
        """
        inverse, logarithms = self._table
        with np.errstate(invalid="ignore", divide="ignore"):
            asked = 1 / np.asarray(kelvin, np.float64)
            inside = (asked <= inverse[0]) & (asked >= inverse[-1])
        return np.where(inside, np.exp(np.interp(asked, inverse[::-1], logarithms[::-1])), np.nan)

    def kelvin(self, counts: Any) -> Array:
        """Temperature [K] of the black body with such a radiance, [...]; NaN where none in the table has it."""
        inverse, logarithms = self._table
        with np.errstate(invalid="ignore", divide="ignore"):
            asked = np.log(np.asarray(counts, np.float64))
            inside = (asked >= logarithms[0]) & (asked <= logarithms[-1])
        return np.where(inside, 1 / np.interp(asked, logarithms, inverse), np.nan)


LONG_WAVE_BAND = LongWaveBand()
"""The band; its table is made when it is first used."""
