"""What temperatures are recalculated with, as the commands and the viewer are told."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from thermosplat.config.values import shown
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError

LEAST_EMISSIVITY = 0.5
"""Below this most of what the camera sees is reflected, and a degree of error in what is reflected becomes more than a
degree of the object: nothing is recalculated. FLIR's manuals and Minkina and Dudzik 2009 advise the same."""
_COLDEST, _HOTTEST = -100.0, 3000.0
"""Of what surrounds an object [°C]."""
_RANGES = {
    "emissivity": (0.01, 1.0, ""),
    "reflected": (_COLDEST, _HOTTEST, " °C"),
    "air": (_COLDEST, 100.0, " °C"),
    "humidity": (0.0, 1.0, ""),
    "window": (0.05, 1.0, ""),
}
_HINTS = {"humidity": "50% is 0.5.", "emissivity": "95% is 0.95.", "window": "It is the share that a window lets pass."}


@dataclass(frozen=True, kw_only=True)
class TemperatureSettings:
    """What temperatures are recalculated with. What is None stays as the capture's files or its
    thermal_parameters.yaml say; where all are None, nothing is recalculated."""

    emissivity: float | None = None
    """Recalculate temperatures with this emissivity of what is seen, 0.5 to 1 (docs/temperatures.md). None: as it was
    applied."""
    reflected: float | None = None
    """Recalculate them with this temperature [°C] of what surfaces reflect. None: as it was applied."""
    air: float | None = None
    """Recalculate them with this temperature [°C] of the air, whose path is each pixel's own distance where the scene
    has a scale in metres. None: as it was applied."""
    humidity: float | None = None
    """Recalculate them with this relative humidity of the air, 0 to 1. None: as it was applied."""
    window: float | None = None
    """Recalculate them with what a window before the lens lets pass, 0 to 1. None: as it was applied."""
    labels: str | None = None
    """Recalculate them with other values by label of label images: a YAML file."""

    @property
    def given(self) -> dict[str, float]:
        """The numbers that are given, by name."""
        named = ((name, getattr(self, name)) for name in _RANGES)
        return {name: float(value) for name, value in named if value is not None}

    @property
    def any_given(self) -> bool:
        """Whether anything is to be recalculated."""
        return bool(self.given) or self.labels is not None

    def checked(self, where: str = "--") -> "TemperatureSettings":
        """These settings, if they are possible.

        Args:
            where: What stands before the names in messages.

        Raises:
            UserError: A number is out of its range.
        """
        for name, value in self.given.items():
            low, high, unit = _RANGES[name]
            if not low <= value <= high:
                raise UserError(
                    f"{where}{name} must be {low:g} to {high:g}{unit}, found {value:g}.", _HINTS.get(name, "")
                )
        return self

    def over(self, others: "TemperatureSettings") -> "TemperatureSettings":
        """These settings, with the others' where these have none."""
        return TemperatureSettings(**{**others.given, **self.given}, labels=self.labels or others.labels)

    @property
    def text(self) -> str:
        """For people: "emissivity 0.8, reflected 20 °C"."""
        return ", ".join(f"{name} {value:g}{_RANGES[name][2]}" for name, value in self.given.items())


@dataclass(frozen=True)
class LabelledSurface:
    """What a label of a label image stands for."""

    name: str
    """What it is called."""
    settings: TemperatureSettings
    """Its own values; what is None is the scene's."""
    mirror: bool = False
    """It mirrors its surroundings: no temperature of it can be recalculated."""


def read_labels(path: Path) -> dict[int, LabelledSurface]:
    """The surfaces of a label file.

        1: {name: glass, emissivity: 0.86, reflected: -10}
        5: {name: chrome, mirror: true}

    Args:
        path: The YAML file. Keys are the values of pixels in label images, 0 to 255.

    Raises:
        UserError: It cannot be read, or has something else.
    """
    return {_label(key, path): _surface(str(key), stated, path) for key, stated in read_yaml(path).items()}


def _label(key: str, path: Path) -> int:
    if not (key.isascii() and key.isdigit() and int(key) <= 255):
        raise UserError(f"{path}: {shown(key)} is no label; labels are the numbers 0 to 255 of a label image's pixels.")
    return int(key)


def _surface(key: str, stated: Any, path: Path) -> LabelledSurface:
    if not isinstance(stated, dict):
        raise UserError(f"{path}: label {key} must be a group of settings, such as name: wall and emissivity: 0.93.")
    known = {field.name: None for field in fields(TemperatureSettings) if field.name != "labels"}
    if unknown := sorted(map(str, stated.keys() - known.keys() - {"name", "mirror"})):
        raise UserError(f"{path}: label {key} has {shown(unknown[0])}; known are name, mirror, {', '.join(known)}.")
    numbers: dict[str, Any] = {name: stated[name] for name in known if stated.get(name) is not None}
    if wrong := [
        name for name, value in numbers.items() if isinstance(value, bool) or not isinstance(value, int | float)
    ]:
        raise UserError(f"{path}: {wrong[0]} of label {key} is {shown(numbers[wrong[0]])}, expected a number.")
    settings = TemperatureSettings(**numbers)
    name = str(stated.get("name", f"label {key}"))
    return LabelledSurface(name, settings.checked(f"{path}: label {key}: "), bool(stated.get("mirror", False)))
