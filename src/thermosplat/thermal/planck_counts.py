"""Counts of a radiometric camera into temperatures, as FLIR cameras state their calibration.

A camera's counts S are linear in the radiance that it sees. Those of a black body of temperature T [K] are Planck's law
with five constants that the maker fits to each camera:

    S(T) = R1 / (R2 (exp(B / T) - F)) - O

On its way to the camera the radiance of the object (emissivity ε) gains that of the surroundings which the object
reflects, is weakened by the air (transmission τ) and by a window (transmission w), and both add radiation of their own.
Half of the air lies before the window and half behind it:

    S1 = ε S(T) + (1 - ε) S(T_reflected)
    S2 = τ S1 + (1 - τ) S(T_air)
    S3 = w S2 + (1 - w) S(T_window)
    S  = τ S3 + (1 - τ) S(T_air)

Sources: FLIR, "User's manual FLIR A3xx series", chapter "Theory of thermography, the measurement formula"; W. Minkina
and S. Dudzik, "Infrared Thermography: Errors and Uncertainties", 2009; G. J. Tattersall, Thermimage (R), ``raw2temp``.
"""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError

ZERO_CELSIUS = 273.15
"""0 °C [K]."""
_WATER = (1.5587, 0.06939, -0.00027816, 0.00000068455)
"""Logarithm of the water content of saturated air [g/m³] as a cubic of its temperature [°C] (FLIR; Minkina and
Dudzik)."""
Array = NDArray[np.float64]


class Law(Protocol):
    """What a camera's signal of a black body is, and back."""

    def counts(self, kelvin: Any) -> Array:
        """Signal of a black body, with nothing between it and the camera.

        Args:
            kelvin: Its temperature [K], [...].
        """

    def kelvin(self, counts: Any) -> Array:
        """Temperature [K] of the black body that has such a signal, [...]; NaN where none has."""


@dataclass(frozen=True, kw_only=True)
class Sightline:
    """What a radiometric camera assumes of an object and of what lies before it.

    Args:
        emissivity: Of the object, in (0, 1].
        reflected: Temperature of what the object reflects [K].
        distance: From the object [m].
        air: Temperature of the air [K].
        humidity: Of the air, in [0, 1].
        window: Temperature of the window in front of the lens [K].
        window_transmission: Of that window, in (0, 1]; 1: there is none.
        alpha1: Attenuation of dry air, first band [m^-1/2].
        alpha2: The same, second band.
        beta1: Attenuation by water, first band.
        beta2: The same, second band.
        x: Share of the first band.
    """

    emissivity: float = 1.0
    reflected: float = 293.15
    distance: float = 0.0
    air: float = 293.15
    humidity: float = 0.5
    window: float = 293.15
    window_transmission: float = 1.0
    alpha1: float = 0.006569
    alpha2: float = 0.01262
    beta1: float = -0.002276
    beta2: float = -0.00667
    x: float = 1.9

    def __post_init__(self) -> None:
        for what, sound in self._possible().items():
            if not sound:
                raise UserError(
                    f"The radiometric calibration is impossible: {what} ({self}).", "Export the file again."
                )

    def _possible(self) -> dict[str, bool]:
        return {
            "emissivity": 0 < self.emissivity <= 1,
            "distance": 0 <= self.distance < 1e6,
            "temperatures": min(self.reflected, self.air, self.window) > 0,
            "humidity": 0 <= self.humidity <= 1,
            "window transmission": 0 < self.window_transmission <= 1,
            "air transmission": 0 < float(self.air_transmission()) <= 1.5,  # x > 1 lets it pass 1 by a little
        }

    def air_transmission(self, distance: Any = None) -> Array:
        """Transmission τ of half of the air between object and camera.

        Args:
            distance: From the object [m], [...]; None: the one that is assumed. NaN gives NaN.
        """
        if not (self.distance >= 0 and self.humidity >= 0):
            return np.float64(math.nan)  # type: ignore[return-value]
        celsius = self.air - ZERO_CELSIUS
        water = self.humidity * math.exp(sum(factor * celsius**power for power, factor in enumerate(_WATER)))
        root = np.sqrt(np.asarray(self.distance if distance is None else distance, np.float64) / 2)
        water_root = math.sqrt(water)
        first = np.exp(-root * (self.alpha1 + self.beta1 * water_root))
        second = np.exp(-root * (self.alpha2 + self.beta2 * water_root))
        return self.x * first + (1 - self.x) * second

    def _added(self, law: Law, distance: Any) -> list[tuple[Any, Array]]:
        """What the radiance meets on its way: the share that passes, and the signal of what is added to the rest."""
        through_air = self.air_transmission(distance)
        return [
            (self.emissivity, law.counts(self.reflected)),
            (through_air, law.counts(self.air)),
            (self.window_transmission, law.counts(self.window)),
            (through_air, law.counts(self.air)),
        ]

    def seen(self, law: Law, celsius: Any, distance: Any = None) -> Array:
        """The camera's signal of objects.

        Args:
            celsius: Temperatures of the objects [°C], [...].
            distance: How far they are [m], [...]; None: as is assumed.
        """
        signal = law.counts(np.asarray(celsius, np.float64) + ZERO_CELSIUS)
        for transmission, own in self._added(law, distance):
            signal = transmission * signal + (1 - transmission) * own
        return signal

    def object_celsius(self, law: Law, counts: Any, distance: Any = None) -> Array:
        """Temperatures of objects from the camera's signal: the inverse of ``seen``.

        Args:
            counts: Its signal, [...].
            distance: How far the objects are [m], [...]; None: as is assumed.

        Returns:
            [...] [°C]; NaN where the signal is below that of absolute zero.
        """
        signal = np.asarray(counts, np.float64)
        for transmission, own in reversed(self._added(law, distance)):
            signal = (signal - (1 - transmission) * own) / transmission
        return law.kelvin(signal) - ZERO_CELSIUS


@dataclass(frozen=True)
class RadiometricCamera(Sightline):
    """The calibration of a radiometric camera, a ``Law``, and what it assumes of the scene.

    Args:
        r1: Planck constant R1.
        r2: Planck constant R2.
        b: Planck constant B [K].
        f: Planck constant F.
        o: Offset O [counts].
    """

    r1: float
    r2: float
    b: float
    f: float
    o: float

    def _possible(self) -> dict[str, bool]:
        planck = self.r1 > 0 and self.r2 > 0 and self.b > 0 and math.isfinite(self.f + self.o)
        return {"Planck constants": planck, **super()._possible()}

    def counts(self, kelvin: Any) -> Array:
        """Counts of a black body, with nothing between it and the camera.

        Args:
            kelvin: Its temperature [K], [...].
        """
        with np.errstate(over="ignore"):  # of a few kelvin
            return self.r1 / (self.r2 * (np.exp(self.b / np.asarray(kelvin, np.float64)) - self.f)) - self.o

    def kelvin(self, counts: Any) -> Array:
        """Temperature [K] of the black body that has such counts, [...]; NaN below those of absolute zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = self.r1 / (self.r2 * (counts + self.o)) + self.f
            return np.where((counts + self.o > 0) & (ratio > 1), self.b / np.log(ratio), np.nan)

    def celsius(self, counts: NDArray[Any]) -> Array:
        """Temperatures of the object.

        Args:
            counts: [...] as the camera stores them.

        Returns:
            [...] [°C]; NaN where counts lie below those of absolute zero.
        """
        return self.object_celsius(self, counts)
