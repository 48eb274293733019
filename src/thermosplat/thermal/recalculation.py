"""Temperatures recalculated after they were measured: what was applied is undone, and something else applied.

A capture's temperature is turned back into the signal that the camera had (``Sightline.seen``, with what was applied),
and that signal into a temperature again with what is asked for. The path through the air may be another one for every
pixel. float64 throughout, and invertible: to ask for what was applied, over the distance that was applied, gives back
the same number.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.temperature_settings import LEAST_EMISSIVITY, LabelledSurface, TemperatureSettings
from thermosplat.thermal.long_wave_band import LONG_WAVE_BAND
from thermosplat.thermal.planck_counts import ZERO_CELSIUS, Law, RadiometricCamera, Sightline
from thermosplat.thermal.thermal_parameters import CaptureParameters, ThermalParameters

Array = NDArray[np.float64]
_UNSTATED = ThermalParameters(applied=False)


@dataclass(frozen=True, eq=False)
class Recalculated:
    """Temperatures, and which of them are others than those of the capture."""

    celsius: Array
    """[...] [°C]; those of the capture where nothing could be recalculated."""
    changed: NDArray[np.bool_]
    """[...], where they were recalculated."""
    reasons: tuple[str, ...] = ()
    """Why they were not elsewhere, a sentence each."""


@dataclass(frozen=True)
class Recalculation:
    """How a capture's temperatures are recalculated.

    Args:
        applied: What the capture's temperatures were computed with.
        stated: What its files say of object and air; settings that are not given are these.
        air_is_known: Somebody has said what the air is, so that its path counts.
        settings: What is asked for, for the scene.
        notes: What to tell people, a sentence each.
    """

    law: Law
    applied: Sightline
    stated: Sightline
    air_is_known: bool
    settings: TemperatureSettings
    surfaces: Mapping[int, LabelledSurface] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        parameters: CaptureParameters | None,
        settings: TemperatureSettings,
        surfaces: Mapping[int, LabelledSurface] | None = None,
    ) -> "Recalculation":
        """What a capture's parameters and the settings make.

        Args:
            parameters: The capture's; None: it says nothing, and its temperatures are taken for those of black bodies
                right before the lens.
            surfaces: The same by label.
        """
        said = _UNSTATED if parameters is None else parameters.stated
        stated = _sightline(said)
        law: Law = LONG_WAVE_BAND if said.planck is None else RadiometricCamera(**said.planck)
        given = [settings, *(surface.settings for surface in (surfaces or {}).values())]
        notes = [] if parameters is None else list(parameters.notes)
        if parameters is None:
            notes.append(
                "Nobody says what this capture's temperatures were computed with, so they are taken for those of black "
                "bodies. thermal_parameters.yaml in its folder can say more (docs/temperatures.md)."
            )
        if said.reflected_celsius is None and all(one.reflected is None for one in given):
            notes.append("What the surfaces reflect is taken to have 20 °C: --reflected says it.")
        by_files = (said.air_celsius, said.humidity, said.distance_metres if said.applied else None)
        by_settings = [value for one in given for value in (one.air, one.humidity)]
        air_is_known = any(value is not None for value in (*by_files, *by_settings))
        applied = stated if said.applied else Sightline()
        return cls(law, applied, stated, air_is_known, settings, surfaces or {}, tuple(notes))

    def asking(self, settings: TemperatureSettings) -> "Recalculation":
        """The same capture, with other settings for the whole scene."""
        known = self.air_is_known or settings.air is not None or settings.humidity is not None
        return replace(self, settings=settings, air_is_known=known)

    @property
    def text(self) -> str:
        """For people: "recalculated: emissivity 0.8"."""
        by_label = f"by {len(self.surfaces)} labels" if self.surfaces else ""
        return f"recalculated: {', '.join(part for part in (self.settings.text, by_label) if part)}"

    def celsius(
        self, celsius: object, distance: object = None, labels: NDArray[np.integer] | None = None
    ) -> Recalculated:
        """Temperatures with what is asked for.

        Args:
            celsius: Those of the capture [°C], [...].
            distance: How far each object is from the camera [m], [...]; NaN or None: as it was stated.
            labels: Label of each, [...]; None, and labels that are not among ``surfaces``: the scene's settings.
        """
        measured = np.asarray(celsius, np.float64)
        if not self.settings.given and labels is None:
            return Recalculated(measured, np.zeros(measured.shape, bool))
        far = self._path_length(distance)
        signal = self.applied.seen(self.law, measured)
        values, changed, reasons = measured.copy(), np.zeros(measured.shape, bool), []
        for surface, where in self._parts(measured.shape, labels):
            asked = surface.settings.over(self.settings)
            if not (asked.given or surface.mirror) or not where.any():
                continue
            if (reason := _refusal(surface, asked, self.stated)) is not None:
                reasons.append(reason)
                continue
            found = self._sightline(asked).object_celsius(self.law, signal[where], None if far is None else far[where])
            sound = np.isfinite(found)
            if (~sound & np.isfinite(measured[where])).any():
                reasons.append(f"{surface.name}: some of it is colder than what it is said to reflect can make it.")
            values[where] = np.where(sound, found, measured[where])
            changed[where] = sound
        return Recalculated(values, changed, tuple(dict.fromkeys(reasons)))

    def _path_length(self, distance: Any) -> Array | None:
        """Distances [m] whose air counts; None: what was stated."""
        if distance is None or not self.air_is_known:
            return None
        return np.where(np.isfinite(distance), distance, self.stated.distance)

    def _parts(
        self, shape: tuple[int, ...], labels: NDArray[np.integer] | None
    ) -> list[tuple[LabelledSurface, NDArray[np.bool_]]]:
        """Surfaces, and where each is; the scene itself where no label of ``surfaces`` is."""
        scene = LabelledSurface("the scene", TemperatureSettings())
        if labels is None or not self.surfaces:
            return [(scene, np.ones(shape, bool))]
        parts = [(surface, labels == label) for label, surface in self.surfaces.items()]
        return [(scene, ~np.isin(labels, list(self.surfaces))), *parts]

    def _sightline(self, asked: TemperatureSettings) -> Sightline:
        """What is asked for, over what is stated. Without a word of the air there is none."""
        changes: dict[str, float] = {} if self.air_is_known else {"distance": 0.0}
        if asked.emissivity is not None:
            changes["emissivity"] = asked.emissivity
        if asked.reflected is not None:
            changes["reflected"] = asked.reflected + ZERO_CELSIUS
        if asked.air is not None:
            changes["air"] = asked.air + ZERO_CELSIUS
        if asked.humidity is not None:
            changes["humidity"] = asked.humidity
        if asked.window is not None:
            changes["window_transmission"] = asked.window
        return replace(self.stated, **changes)


def _refusal(surface: LabelledSurface, asked: TemperatureSettings, stated: Sightline) -> str | None:
    """Why a surface's temperatures are not recalculated; None: they are."""
    emissivity = stated.emissivity if asked.emissivity is None else asked.emissivity
    if surface.mirror:
        return f"{surface.name}: not recalculated, since it mirrors its surroundings."
    if emissivity < LEAST_EMISSIVITY:
        return (
            f"{surface.name}: not recalculated, since most of what the camera sees is reflected where the "
            f"emissivity is {emissivity:g} (below {LEAST_EMISSIVITY:g})."
        )
    return None


def _sightline(said: ThermalParameters) -> Sightline:
    numbers: dict[str, float | None] = {
        "emissivity": said.emissivity,
        "reflected": _kelvin(said.reflected_celsius),
        "distance": said.distance_metres,
        "air": _kelvin(said.air_celsius),
        "humidity": said.humidity,
        "window": _kelvin(said.window_celsius),
        "window_transmission": said.window_transmission,
        **(said.air or {}),
    }
    return Sightline(**{name: value for name, value in numbers.items() if value is not None})


def _kelvin(celsius: float | None) -> float | None:
    return None if celsius is None else celsius + ZERO_CELSIUS
