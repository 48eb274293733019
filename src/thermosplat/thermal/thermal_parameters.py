"""thermal_parameters.json: what each thermal file says of its object, the air before it and its camera.

    {"images": {"0001.png": {
       "applied": true,
       "emissivity": 0.95, "reflected_celsius": 22.0, "distance_metres": 2.0, "air_celsius": 17.0, "humidity": 0.5,
       "window_celsius": 20.0, "window_transmission": 1.0,
       "planck": {"r1": 16028.3, "r2": 0.0841, "b": 1418.7, "f": 1.15, "o": -10430},
       "air": {"alpha1": 0.006569, "alpha2": 0.01262, "beta1": -0.002276, "beta2": -0.00667, "x": 1.9}}}}

Names are those of the thermal images in the capture. What a file does not say is left out. ``applied`` says what the
temperatures of the capture are: computed with these values (true), or those of a black body before the lens (false),
for which emissivity, reflection and air are still to be corrected. The formula is in ``planck_counts``.

A person may say the same of all images in ``thermal_parameters.yaml`` beside it, where files say nothing or another
thing than is true: the keys of one image, at the file's top.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from thermosplat.config.values import shown
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError
from thermosplat.thermal.planck_counts import ZERO_CELSIUS, RadiometricCamera

_PLANCK = ("r1", "r2", "b", "f", "o")
_AIR = ("alpha1", "alpha2", "beta1", "beta2", "x")


@dataclass(frozen=True, kw_only=True)
class ThermalParameters:
    """What one thermal file says; None for what it does not say.

    Args:
        applied: Its temperatures in the capture were computed with these values.
        emissivity: Of the object, in (0, 1].
        reflected_celsius: Temperature of what the object reflects [°C].
        distance_metres: From the object [m].
        air_celsius: Temperature of the air [°C].
        humidity: Of the air, in [0, 1].
        window_celsius: Temperature of the window in front of the lens [°C].
        window_transmission: Of that window, in (0, 1].
        planck: Planck constants R1, R2, B, F and O of the camera, by their names in small letters.
        air: Constants of the air's attenuation: alpha1, alpha2, beta1, beta2, x.
    """

    applied: bool
    emissivity: float | None = None
    reflected_celsius: float | None = None
    distance_metres: float | None = None
    air_celsius: float | None = None
    humidity: float | None = None
    window_celsius: float | None = None
    window_transmission: float | None = None
    planck: Mapping[str, float] | None = None
    air: Mapping[str, float] | None = None

    @classmethod
    def of_camera(cls, camera: RadiometricCamera) -> "ThermalParameters":
        """Those of a calibration with which temperatures were computed."""
        return cls(
            applied=True,
            emissivity=camera.emissivity,
            reflected_celsius=camera.reflected - ZERO_CELSIUS,
            distance_metres=camera.distance,
            air_celsius=camera.air - ZERO_CELSIUS,
            humidity=camera.humidity,
            window_celsius=camera.window - ZERO_CELSIUS,
            window_transmission=camera.window_transmission,
            planck={name: getattr(camera, name) for name in _PLANCK},
            air={name: getattr(camera, name) for name in _AIR},
        )


def parameters_text(images: Mapping[str, ThermalParameters]) -> str:
    """The content of a thermal_parameters.json.

    Args:
        images: What was said of each thermal image, by its name in the capture.
    """
    stated = {
        name: {key: value for key, value in asdict(one).items() if value is not None} for name, one in images.items()
    }
    return json.dumps({"images": stated}, indent=1) + "\n"


def read_parameters(path: Path) -> dict[str, ThermalParameters]:
    """What a thermal_parameters.json says, by the name of the image; nothing where there is no such file.

    Raises:
        UserError: The file is damaged.
    """
    try:
        return {name: _parameters(one) for name, one in json.loads(path.read_bytes())["images"].items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is damaged: {type(error).__name__}: {error}.",
            "Import the thermal files again: thermosplat-prepare import FOLDER --out CAPTURE",
        ) from error


@dataclass(frozen=True)
class CaptureParameters:
    """What is known of all thermal images of a capture together."""

    stated: ThermalParameters
    """The median over the images of each number that they state; a person's own statement goes before."""
    notes: tuple[str, ...] = ()
    """What differs between the images, a sentence each."""


def capture_parameters(folder: Path) -> CaptureParameters | None:
    """What a capture's thermal_parameters.json and thermal_parameters.yaml say of its temperatures.

    Returns:
        None where it has neither file.

    Raises:
        UserError: A file is damaged, or states what is impossible.
    """
    images = list(read_parameters(folder / "thermal_parameters.json").values())
    by_hand = folder / "thermal_parameters.yaml"
    own = _by_hand(by_hand) if by_hand.is_file() else None
    if not images:
        return None if own is None else CaptureParameters(own)
    notes = []
    numbers: dict[str, Any] = {"applied": sum(one.applied for one in images) * 2 > len(images)}
    if len({one.applied for one in images}) > 1:
        notes.append("Some images' temperatures were computed with what their files state, and others' were not.")
    for field in fields(ThermalParameters)[1:]:
        found = [value for one in images if (value := getattr(one, field.name)) is not None]
        if not found:
            continue
        if field.name in ("planck", "air"):
            numbers[field.name] = max(found, key=found.count)
        else:
            numbers[field.name] = float(np.median(found))
            if max(found) - min(found) > 1e-3 * max(abs(max(found)), 1.0):
                notes.append(
                    f"The files' {field.name} ranges from {min(found):g} to {max(found):g}; "
                    f"their median {numbers[field.name]:g} stands for all of them."
                )
    if own is not None:
        numbers |= {name: value for name, value in asdict(own).items() if value is not None}
    return CaptureParameters(ThermalParameters(**numbers), tuple(notes))


def _by_hand(path: Path) -> ThermalParameters:
    stated = read_yaml(path)
    known = [field.name for field in fields(ThermalParameters)]
    hint = "docs/temperatures.md has an example."
    if unknown := sorted(stated.keys() - set(known)):
        raise UserError(f"{path} has {shown(unknown[0])}; known are {', '.join(known)}.", hint)
    if not isinstance(stated.get("applied"), bool):
        raise UserError(
            f"{path} must say what the capture's temperatures are: applied: true, computed with these values; or "
            "applied: false, those of a black body before the lens.",
            hint,
        )
    try:
        return _parameters(stated)
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} states what is no number: {type(error).__name__}: {error}.", hint) from error


def _parameters(stated: Mapping[str, Any]) -> ThermalParameters:
    values: dict[str, Any] = {"applied": bool(stated["applied"])}
    for field in fields(ThermalParameters)[1:]:
        value = stated.get(field.name)
        if field.name in ("planck", "air"):
            names = _PLANCK if field.name == "planck" else _AIR
            values[field.name] = None if value is None else {name: _finite(value[name]) for name in names}
        else:
            values[field.name] = None if value is None else _finite(value)
    return ThermalParameters(**values)


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is no number")
    return number
